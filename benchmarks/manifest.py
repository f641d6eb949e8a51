"""Check `data_manifest.yaml`, or measure its sizes and digests anew: python -m benchmarks.manifest [--rewrite]."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tubepose.capture.manifest import Manifest, manifest_entry_for, read_manifest, verify_manifest, write_manifest
from tubepose.errors import CaptureError

ROOT = Path(__file__).resolve().parent.parent


def rewritten(manifest: Manifest, root: Path) -> Manifest:
    """The same data sets with sizes and digests measured anew."""
    kept = ("name", "source", "sensor", "licence", "split", "simulated")
    entries = [
        manifest_entry_for(root / entry.path, root, **{key: getattr(entry, key) for key in kept})
        for entry in manifest.data_sets
    ]
    return Manifest(data_sets=tuple(entries))


def main(arguments: list[str] | None = None) -> int:
    """Run the command; 1 if the manifest and the files differ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rewrite", action="store_true", help="write the measured sizes and digests")
    parser.add_argument("--manifest", type=Path, default=ROOT / "data_manifest.yaml")
    options = parser.parse_args(arguments)
    try:
        manifest = read_manifest(options.manifest)
        if options.rewrite:
            manifest = rewritten(manifest, options.manifest.resolve().parent)
            write_manifest(options.manifest, manifest)
    except CaptureError as problem:
        print(problem, file=sys.stderr)
        return 1
    problems = verify_manifest(manifest, options.manifest.resolve().parent)
    for problem in problems:
        print(problem, file=sys.stderr)
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
