"""Built-in labware definitions, one YAML file each; docs/labware.md explains every key."""
