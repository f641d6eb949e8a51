from __future__ import annotations

import hashlib
from pathlib import Path

import pytest
from commands import tubepose
from pydantic import ValidationError

from tubepose.capture.manifest import (
    Manifest,
    check_data_set,
    manifest_entry_for,
    read_manifest,
    tree_sha256,
    with_entry,
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
    digests = {name: hashlib.sha256(data).hexdigest() for name, data in (("b.bin", b"bbb"), ("deep/a.bin", b"aa"))}
    listing = "".join(f"{digest}  {name}\n" for name, digest in digests.items())
    assert (folder.bytes, folder.path) == (5, "data")
    assert [(each.path, each.bytes, each.sha256) for each in folder.files] == [
        (name, size, digests[name]) for name, size in (("b.bin", 3), ("deep/a.bin", 2))
    ]
    assert folder.sha256 == hashlib.sha256(listing.encode()).hexdigest() == tree_sha256(root / "data")
    assert (file.bytes, file.sha256) == (3, digests["b.bin"])


def test_manifest_survives_the_round_trip_with_a_line_per_file(root):
    manifest = Manifest(data_sets=(entry(root), entry(root, "data/b.bin", name="two", simulated=False)))
    path = root / "data_manifest.yaml"
    write_manifest(path, manifest)
    assert read_manifest(path) == manifest
    lines = path.read_text().splitlines()
    for file in manifest.data_sets[0].files:
        assert f"  - {{path: {file.path}, bytes: {file.bytes}, sha256: {file.sha256}}}" in lines
    assert [check_data_set(each, root).state for each in manifest.data_sets] == ["ok", "ok"]


def test_an_entry_takes_the_place_of_its_namesake(root):
    one, two = entry(root), entry(root, "data/b.bin", name="two")
    other = entry(root, "data/b.bin", split="dev")
    assert with_entry(Manifest(data_sets=(one,)), two).data_sets == (one, two)
    assert with_entry(Manifest(data_sets=(one, two)), other).data_sets == (other, two)


def test_every_differing_file_is_one_line(root):
    known = entry(root)
    (root / "data" / "deep" / "a.bin").write_bytes(b"ab")
    check = check_data_set(known, root)
    assert check.state == "differs"
    (line,) = check.differences
    assert line.startswith("one: data/deep/a.bin: sha256 ")
    assert line.endswith(f"; expected {known.files[1].sha256}")
    (root / "data" / "deep" / "a.bin").rename(root / "data" / "deep" / "c.bin")
    (root / "data" / "b.bin").write_bytes(b"bbbb")
    assert check_data_set(known, root).differences == (
        "one: data/b.bin: 4 bytes; expected 3",
        "one: data/deep/a.bin: missing; expected 2 bytes",
        "one: data/deep/c.bin: not in the manifest",
    )


def test_a_data_set_of_one_file_is_checked_as_one(root):
    known = entry(root, "data/b.bin")
    (root / "data" / "b.bin").write_bytes(b"bbc")
    assert check_data_set(known, root).differences[0].startswith("one: data/b.bin: sha256 ")


def test_what_is_not_there_or_empty_is_absent(root):
    known = entry(root, "data/deep")
    (root / "data" / "deep" / "a.bin").unlink()
    assert (check_data_set(known, root).state, check_data_set(known, root).differences) == ("absent", ())
    (root / "data" / "deep").rmdir()
    assert check_data_set(known, root).state == "absent"


def test_a_link_to_another_disk_is_in_its_place(root, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("disk")
    (elsewhere / "a").write_bytes(b"a")
    (root / "linked").symlink_to(elsewhere)
    assert entry(root, "linked").path == "linked"


def test_wrong_manifest_is_refused(root):
    path = root / "data_manifest.yaml"
    write_manifest(path, Manifest(data_sets=(entry(root), entry(root))))
    with pytest.raises(CaptureError, match="found twice: one"):
        read_manifest(path)
    write_manifest(path, Manifest(data_sets=(entry(root),)))
    whole = path.read_text()
    path.write_text(whole.replace("licence:", "license:"))
    with pytest.raises(CaptureError, match=r"unknown key 'data_sets\.0\.license'; known keys: name, path"):
        read_manifest(path)
    path.write_text(whole.replace("bytes: 5", "bytes: 6"))
    with pytest.raises(CaptureError, match="one: bytes is 6; expected the sum of its files"):
        read_manifest(path)
    path.write_text(whole.replace("deep/a.bin", "deep/b.bin"))
    with pytest.raises(CaptureError, match="one: sha256 is not that of the listing"):
        read_manifest(path)
    with pytest.raises(ValidationError, match="split"):
        entry(root, split="all")
    with pytest.raises(CaptureError, match="expected an existing file or folder under"):
        entry(root, "gone")


def test_manifest_of_the_repository_is_true():
    manifest = read_manifest(REPOSITORY / "data_manifest.yaml")
    sample = next(data for data in manifest.data_sets if data.path == "tubepose/sample")
    assert (sample.simulated, sample.split) == (True, "dev")
    if not (REPOSITORY / sample.path).exists():
        pytest.skip("the bundled sample is not in this checkout")
    for data_set in manifest.data_sets:
        assert check_data_set(data_set, REPOSITORY).differences == ()


# The command


@pytest.fixture
def manifest(root):
    path = root / "data_manifest.yaml"
    gone = entry(root, "data/deep", name="gone").model_copy(update={"path": "elsewhere", "source": "make it so"})
    write_manifest(path, Manifest(data_sets=(entry(root), gone)))
    return path


def test_verify_lists_every_set_and_how_to_get_an_absent_one(manifest):
    ended = tubepose("data", "verify", "--manifest", manifest)
    assert (ended.code, ended.err) == (0, "")
    (one,) = [line for line in ended.out.splitlines() if " one " in line]
    assert all(word in one for word in ("test", " 2 ", " 5 ", "ok"))
    (gone,) = [line for line in ended.out.splitlines() if "│ gone " in line]
    assert "absent" in gone
    assert "gone is not here; it comes from: make it so" in ended.out


def test_verify_fails_with_a_line_per_differing_file(root, manifest):
    (root / "data" / "b.bin").write_bytes(b"bbc")
    (root / "data" / "new.bin").write_bytes(b"n")
    (root / "data" / "deep" / "a.bin").unlink()
    ended = tubepose("data", "verify", "--manifest", manifest)
    assert ended.code == 1
    assert "differs" in ended.out
    first, second, third = ended.err.splitlines()
    assert first.startswith("error: one: data/b.bin: sha256 ")
    assert second == "error: one: data/deep/a.bin: missing; expected 2 bytes"
    assert third == "error: one: data/new.bin: not in the manifest"


def test_verify_of_named_sets_wants_them_here(root, manifest, tmp_path_factory):
    assert tubepose("data", "verify", "one", "--manifest", manifest).code == 0
    ended = tubepose("data", "verify", "gone", "--manifest", manifest)
    assert (ended.code, ended.err) == (1, "error: gone is not here; it comes from: make it so\n")
    ended = tubepose("data", "verify", "on", "--manifest", manifest)
    assert (ended.code, ended.err) == (1, "error: unknown data set 'on'; did you mean 'one'?; known: one, gone\n")
    away = tmp_path_factory.mktemp("away")
    ended = tubepose("data", "verify", "one", "--manifest", manifest, "--root", away)
    assert (ended.code, ended.errors) == (1, ["error: one is not here; it comes from: made here"])


def test_verify_without_a_manifest_says_how_to_name_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ended = tubepose("data", "verify")
    assert (ended.code, ended.out) == (1, "")
    assert ended.err == "error: data_manifest.yaml: no such file; name the manifest with --manifest FILE\n"
