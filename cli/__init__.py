"""The `tubepose` command line: parse, call, show. Installed as `tubepose_cli`."""
