from __future__ import annotations

import hashlib
import importlib.util
from pathlib import Path

import pytest
from pydantic import ValidationError

from tubepose.capture.manifest import (
    Manifest,
    manifest_entry_for,
    read_manifest,
    verify_manifest,
    write_manifest,
)
from tubepose.errors import CaptureError

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture
def root(tmp_path):
    (tmp_path / "data" / "deep").mkdir(parents=True)
    (tmp_path / "data" / "b.bin").write_bytes(b"bbb")
    (tmp_path / "data" / "deep" / "a.bin").write_bytes(b"aa")
    (tmp_path / "data" / ".hidden").write_bytes(b"x")
    return tmp_path


def entry(root: Path, place: str = "data", **changes):
    told = {"name": "one", "source": "made here", "sensor": "none", "licence": "Apache-2.0", "simulated": True}
    told["split"] = "test"
    return manifest_entry_for(root / place, root, **(told | changes))


def test_folder_and_file_are_measured(root):
    folder, file = entry(root), entry(root, "data/b.bin")
    listing = "".join(
        f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in (("b.bin", b"bbb"), ("deep/a.bin", b"aa"))
    )
    assert (folder.bytes, folder.files, folder.path) == (5, 2, "data")
    assert folder.sha256 == hashlib.sha256(listing.encode()).hexdigest()
    assert (file.bytes, file.files, file.sha256) == (3, 1, hashlib.sha256(b"bbb").hexdigest())


def test_manifest_survives_the_round_trip(root):
    manifest = Manifest(data_sets=(entry(root), entry(root, "data/b.bin", name="two", simulated=False)))
    write_manifest(root / "data_manifest.yaml", manifest)
    assert read_manifest(root / "data_manifest.yaml") == manifest
    assert verify_manifest(manifest, root) == []


def test_every_difference_is_one_line(root):
    manifest = Manifest(data_sets=(entry(root), entry(root, "data/b.bin", name="two")))
    (root / "data" / "deep" / "a.bin").write_bytes(b"ab")
    (problem,) = verify_manifest(manifest, root)
    assert problem.startswith("one: data has the sha256 ")
    (root / "data" / "deep" / "a.bin").rename(root / "data" / "deep" / "c.bin")
    (root / "data" / "b.bin").write_bytes(b"bbbb")
    first, second = verify_manifest(manifest, root)
    assert "data has 6 bytes in 2 file(s), the manifest says 5 in 2" in first
    assert "data/b.bin has 4 bytes in 1 file(s), the manifest says 3 in 1" in second
    (root / "data" / "b.bin").unlink()
    assert "data/b.bin is not there; it is from made here" in verify_manifest(manifest, root)[1]


def test_wrong_manifest_is_refused(root):
    path = root / "data_manifest.yaml"
    write_manifest(path, Manifest(data_sets=(entry(root), entry(root))))
    with pytest.raises(CaptureError, match="found twice: one"):
        read_manifest(path)
    write_manifest(path, Manifest(data_sets=(entry(root),)))
    path.write_text(path.read_text().replace("licence:", "license:"))
    with pytest.raises(CaptureError, match=r"unknown key 'data_sets\.0\.license'; known keys: name, path"):
        read_manifest(path)
    with pytest.raises(ValidationError, match="split"):
        entry(root, split="all")
    with pytest.raises(CaptureError, match="expected an existing file or folder under"):
        entry(root, "gone")


def command():
    """The script is no part of an installed package: it is loaded from its file."""
    spec = importlib.util.spec_from_file_location("manifest_command", REPOSITORY / "benchmarks" / "manifest.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.main


def test_command_rewrites_and_checks(root, capsys):
    main = command()
    path = root / "data_manifest.yaml"
    write_manifest(path, Manifest(data_sets=(entry(root),)))
    (root / "data" / "b.bin").write_bytes(b"changed")
    assert main(["--manifest", str(path)]) == 1
    assert "the manifest says 5" in capsys.readouterr().err
    assert main(["--manifest", str(path), "--rewrite"]) == 0
    assert read_manifest(path).data_sets[0].bytes == 9
    assert main(["--manifest", str(path)]) == 0


def test_manifest_of_the_repository_is_true():
    manifest = read_manifest(REPOSITORY / "data_manifest.yaml")
    sample = next(data for data in manifest.data_sets if data.path == "tubepose/sample")
    assert sample.simulated
    if not (REPOSITORY / sample.path).exists():
        pytest.skip("the bundled sample is not in this checkout")
    assert verify_manifest(manifest, REPOSITORY) == []
