"""The benchmark set of benchmarks/recipe.yaml: simulated, recorded in data_manifest.yaml, and the sample cut from it.

    python -m benchmarks.dataset make dev|test       # data/dev, data/test; a run that was stopped goes on
    python -m benchmarks.dataset record dev|test     # measure a set that is there anew, for the manifest
    python -m benchmarks.dataset twin dev --sensor raycast --out data/dev-raycast    # the same scenes, another sensor
    python -m benchmarks.dataset sample              # the first trials of data/dev become tubepose/sample

With --trials or --resolution a set is not the recipe's, and with --out it is not in its place: neither is recorded.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, Field

from tubepose.capture.manifest import Split, manifest_entry_for, read_manifest, with_entry, write_manifest
from tubepose.capture.session import SESSION_FILE, load_session
from tubepose.capture.source import TRUTH_FOLDER
from tubepose.errors import ConfigError, TubePoseError
from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.labware.reading import read_yaml, validate
from tubepose.simulation import simulate_session
from tubepose.simulation.shooting import CaptureFormat
from tubepose.simulation.variation import SceneVariation, scene_variation
from tubepose_cli.show import counted_progress
from tubepose_cli.simulate import available_cores

ROOT = Path(__file__).resolve().parent.parent
RECIPE = ROOT / "benchmarks" / "recipe.yaml"
MANIFEST = ROOT / "data_manifest.yaml"


class SetRecipe(BaseModel):
    """What one set has of its own: its seed, and ranges that go before those of all sets."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    seed: int = Field(ge=0)
    scenes: dict[str, Any] = {}


class Recipe(BaseModel):
    """Contents of recipe.yaml; names and numbers are those of `simulate_session`."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    rack: str
    tubes: tuple[str, ...]
    cap: str
    trials: int = Field(ge=1)
    resolution: int = Field(ge=32)
    sensor: str
    capture_format: CaptureFormat
    licence: str
    scenes: dict[str, Any] = {}
    sets: dict[Split, SetRecipe]

    def variation(self, name: Split) -> SceneVariation:
        """Ranges that the scenes of a set are drawn from."""
        return scene_variation(self.scenes | self.sets[name].scenes, f"scenes of {name}")


def read_recipe(path: Path = RECIPE) -> Recipe:
    """Read a recipe.

    Raises:
        ConfigError: Missing, or it breaks the format.
    """
    return validate(Recipe, read_yaml(path, ConfigError), str(path), ConfigError)


def simulate(recipe: Recipe, name: Split, out: Path, threads: int) -> None:
    """Simulate a set; what a stopped run has finished is kept, and the next one goes on from it."""
    with counted_progress(f"captures of {out.name}") as show:
        simulate_session(
            out,
            load_rack(recipe.rack),
            [load_tube(tube) for tube in recipe.tubes],
            trials=recipe.trials,
            seed=recipe.sets[name].seed,
            cap=load_cap(recipe.cap),
            sensor=recipe.sensor,
            resolution=recipe.resolution,
            variation=recipe.variation(name),
            capture_format=recipe.capture_format,
            threads=threads,
            resume=True,
            progress=show,
        )


def record(place: Path, manifest: Path, name: str, source: str, split: Split, recipe: Recipe) -> None:
    """Put a set into the manifest with the size and digest of every file."""
    entry = manifest_entry_for(
        place,
        manifest.resolve().parent,
        name=name,
        source=source,
        sensor=f"simulated structured-light camera ({recipe.sensor})",
        licence=recipe.licence,
        split=split,
        simulated=True,
    )
    write_manifest(manifest, with_entry(read_manifest(manifest), entry))
    print(f"{name}: {len(entry.files)} files, {entry.bytes} bytes, in {manifest}", file=sys.stderr)


def cut_sample(session: Path, sample: Path, trials: int, most_tubes: int) -> None:
    """Make the sample from the first trials of each tube of a session, in the place of the one that is there.

    Trials with more than `most_tubes` tubes are passed over: a demonstration should be quick, and show the rack.

    Raises:
        CaptureError: The session cannot be read.
    """
    load_session(session)
    data = yaml.safe_load((session / SESSION_FILE).read_text(encoding="utf-8"))
    groups: dict[str, list[dict[str, Any]]] = {}
    for trial in data["trials"]:
        groups.setdefault(trial["name"].rsplit("-", 1)[0], []).append(trial)
    small = [[trial for trial in group if len(trial["tubes"]) <= most_tubes] for group in groups.values()]
    kept = [trial for group in small for trial in group[:trials]]
    aside, old = (sample.with_name(f".{sample.name}.{word}") for word in ("part", "old"))
    for folder in (aside, old):
        shutil.rmtree(folder, ignore_errors=True)
    places = [trial[label] for trial in kept for label in ("printed", "original")]
    places += [f"{TRUTH_FOLDER}/{trial['name']}.yaml" for trial in kept]
    places += ["labware"] if (session / "labware").is_dir() else []
    for place in places:
        (aside / place).parent.mkdir(parents=True, exist_ok=True)
        copy = shutil.copytree if (session / place).is_dir() else shutil.copyfile
        copy(session / place, aside / place)
    # Rows of the sample and of the whole session are told apart by the session's name.
    data |= {"name": f"{data['name']}-sample", "trials": kept}
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120)
    (aside / SESSION_FILE).write_text(text, encoding="utf-8")
    if sample.exists():
        sample.rename(old)
    aside.rename(sample)
    shutil.rmtree(old, ignore_errors=True)


def make(options: argparse.Namespace, recipe: Recipe) -> None:
    """Simulate a set or its twin; record it if it is the recipe's and lies in its place."""
    asked = {key: getattr(options, key, None) for key in ("trials", "resolution", "sensor")}
    changes = {key: value for key, value in asked.items() if value not in (None, getattr(recipe, key))}
    place = set_place(options)
    out = place if options.out is None else options.out
    if options.command == "make" and options.out is not None:
        out = options.out / options.name
    in_place = out.resolve() == place.resolve()
    if in_place and changes:
        found = ", ".join(f"--{key} {value}" for key, value in changes.items())
        raise ConfigError(f"{found}: {place} is for what the recipe says; give another --out")
    simulate(recipe.model_copy(update=changes), options.name, out, options.threads)
    if in_place:
        record_set(options, recipe)


def record_set(options: argparse.Namespace, recipe: Recipe) -> None:
    """Record a set that lies in its place."""
    source = f"python -m benchmarks.dataset make {options.name}"
    record(set_place(options), options.manifest, options.name, source, options.name, recipe)


def make_sample(options: argparse.Namespace, recipe: Recipe) -> None:
    """Cut the sample; record it if it lies in its place."""
    root = options.manifest.resolve().parent
    place = root / "tubepose" / "sample"
    cut_sample(options.session or root / "data" / "dev", options.out or place, options.trials, options.most_tubes)
    if options.out is None:
        source = f"python -m benchmarks.dataset sample --trials {options.trials} --most-tubes {options.most_tubes}"
        record(place, options.manifest, "sample", source, "dev", recipe)


def set_place(options: argparse.Namespace) -> Path:
    """Where a set of the recipe belongs."""
    return Path(options.manifest.resolve().parent / "data" / options.name)


def parser() -> argparse.ArgumentParser:
    """Parser of the command line."""
    whole = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    whole.add_argument("--recipe", type=Path, default=RECIPE)
    whole.add_argument("--manifest", type=Path, default=MANIFEST)
    commands = whole.add_subparsers(dest="command", required=True)
    for command in ("make", "twin", "record"):
        one = commands.add_parser(command)
        one.add_argument("name", help="set of the recipe")
        if command == "record":
            continue
        one.add_argument("--threads", type=int, default=available_cores())
        one.add_argument("--trials", type=int)
        one.add_argument("--resolution", type=int)
        one.add_argument("--out", type=Path, required=command == "twin")
        if command == "twin":
            one.add_argument("--sensor", required=True)
    sample = commands.add_parser("sample")
    sample.add_argument("--trials", type=int, default=1, help="per tube")
    sample.add_argument("--most-tubes", type=int, default=99, help="pass over trials with more")
    sample.add_argument("--session", type=Path)
    sample.add_argument("--out", type=Path)
    return whole


def main(arguments: list[str] | None = None) -> int:
    """Run the command; 1 if it could not be done."""
    options = parser().parse_args(arguments)
    try:
        recipe = read_recipe(options.recipe)
        if options.command != "sample" and options.name not in recipe.sets:
            raise ConfigError(f"no set '{options.name}' in {options.recipe}; its sets: {', '.join(recipe.sets)}")
        {"make": make, "twin": make, "record": record_set, "sample": make_sample}[options.command](options, recipe)
    except (TubePoseError, OSError) as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
