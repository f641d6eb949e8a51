"""Commands that produce the numbers of benchmarks/README.md, on the public API alone."""
