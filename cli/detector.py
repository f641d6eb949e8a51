"""`tubepose detector`: labelled pictures by rendering, training, and judging detectors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from tubepose_cli.paths import named

if TYPE_CHECKING:
    from tubepose.detection.evaluation import DetectionReport
    from tubepose.training.images import ImageSet
    from tubepose.training.scenes import Stock

app = typer.Typer(help="Detectors that learn from labware files alone, and how good they are.", no_args_is_help=True)
CATALOGUE = "catalogue"
BUNDLED = "bundled"
SUMMARY_FILE, SUCCESS_FILE, WORST_FILE = "detection_summary.csv", "detection_success.csv", "worst.png"
_UNSEEN_SEED = 1_000_003
"""Added to a seed for pictures to judge by."""


@app.command()
def render(
    out: Annotated[
        Path,
        typer.Option(
            parser=named, metavar="PATH", help="Folder for the pictures and labels; one that was cut off goes on."
        ),
    ],
    labware: Annotated[
        str, typer.Option(help="Racks, tubes and printed caps: names or files, with commas; or catalogue.")
    ] = CATALOGUE,
    count: Annotated[int, typer.Option(min=1, help="Pictures in all.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same pictures.")] = 0,
    side: Annotated[int, typer.Option(min=96, max=2064, help="Longer side of the pictures, pixels.")] = 640,
    variants: Annotated[float, typer.Option(min=0, max=1, help="Share of random variants of the labware.")] = 0.5,
    view: Annotated[
        Literal["any", "scanner", "rack"],
        typer.Option(help="any: from anywhere. scanner: one rack, from above. rack: the same, cut to the rack."),
    ] = "any",
    fill: Annotated[
        str | None, typer.Option(metavar="SHARE", help="Occupied slots: 0.3 or 0.1-0.4; default: empty to full.")
    ] = None,
    mixed: Annotated[
        float, typer.Option(min=0, max=1, help="Share of the racks in which hardly two tubes are of one kind.")
    ] = 0.0,
    quality: Annotated[
        Literal["any", "good"],
        typer.Option(help="any: out of focus and too bright as well. good: a camera that someone has set up."),
    ] = "any",
    held_out: Annotated[bool, typer.Option("--held-out", help="Grounds that no training picture has.")] = False,
    threads: Annotated[int, typer.Option(min=0, help="0: one per core. They change no picture.")] = 0,
) -> None:
    """Render SIMULATED pictures with exact boxes, as YOLO label files."""
    from dataclasses import replace

    from tubepose.errors import ConfigError
    from tubepose.training.images import ImageSet
    from tubepose_cli.show import say
    from tubepose_cli.simulate import available_cores, read_range

    shares = read_range("--fill", fill) if fill is not None else None
    if shares is not None and not shares[0] <= shares[1] <= 1.0:
        raise ConfigError(f"--fill {fill}: expected shares of the slots from 0 to 1, the least first")
    drawn = replace(read_labware_list(labware), variants=variants, held_out=held_out, fill=shares, mixed=mixed)
    _render(out, ImageSet(drawn, seed, side, view, quality), count, threads or available_cores())
    say(f"{out}: {count} rendered pictures with labels")


@app.command()
def train(
    out: Annotated[Path, typer.Option(parser=named, metavar="PATH", help="The .onnx file to write.")],
    labware: Annotated[
        str, typer.Option(help="Racks, tubes and printed caps: names or files, with commas; or catalogue.")
    ] = CATALOGUE,
    pictures: Annotated[int, typer.Option(min=1, help="Pictures to render and learn from.")] = 2000,
    steps: Annotated[int, typer.Option(min=1, help="Batches to learn from.")] = 4000,
    batch: Annotated[int, typer.Option(min=1, help="Samples a batch.")] = 8,
    sample_side: Annotated[int, typer.Option(min=96, help="Side of a training sample, pixels.")] = 384,
    late_side: Annotated[int, typer.Option(min=96, help="Its side in the last fifth of the training.")] = 544,
    side: Annotated[int, typer.Option(min=96, help="Longer side of the model's input for one rack.")] = 640,
    whole_side: Annotated[int, typer.Option(min=96, help="The same for a whole picture, where it finds racks.")] = 416,
    picture_side: Annotated[int, typer.Option(min=96, max=2064, help="Longer side of rendered pictures.")] = 1024,
    variants: Annotated[float, typer.Option(min=0, max=1, help="Share of random variants of the labware.")] = 0.5,
    view: Annotated[
        Literal["any", "scanner", "rack"],
        typer.Option(help="any: from anywhere. scanner: one rack, from above. rack: the same, cut to the rack."),
    ] = "any",
    seed: Annotated[int, typer.Option(min=0, help="Of the pictures and of the training.")] = 0,
    images: Annotated[
        list[Path] | None,
        typer.Option(
            help="Learn from this set (images/, labels/, classes.txt; a data.yaml) and render none; "
            "several: give it again."
        ),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(
            metavar="bundled|FILE",
            help="Start from the bundled model, or from the .onnx or checkpoint.pt of another training; "
            "default: from photographs.",
        ),
    ] = None,
    rate: Annotated[float, typer.Option(min=1e-7, help="Largest learning rate.")] = 1e-3,
    unseen: Annotated[int, typer.Option(min=0, help="Further pictures to judge the model by; 0 for none.")] = 60,
    work: Annotated[Path | None, typer.Option(help="Folder of pictures and checkpoint; default: beside --out.")] = None,
    threads: Annotated[int, typer.Option(min=0, help="0: one per core.")] = 0,
) -> None:
    """Train a detector from labware files alone, on rendered pictures. A training that was cut off goes on."""
    from dataclasses import replace

    from tubepose.detection.closer_look import MARGIN, Looks
    from tubepose.detection.labelled_images import labelled_set, labelled_sets
    from tubepose.detection.yolo_session import SIZE_STEP
    from tubepose.errors import ConfigError
    from tubepose.labware.reading import validate
    from tubepose.training.images import ImageSet
    from tubepose.training.loop import Recipe
    from tubepose.training.network import require_packages
    from tubepose.training.train import LOSS_FILE, SAMPLES_FILE, TrainingJob, train_detector
    from tubepose_cli.show import counted_progress, say
    from tubepose_cli.simulate import available_cores

    begin = _start_file(start)
    if out.suffix != ".onnx":
        raise ConfigError(f"--out {out}: expected a name that ends in .onnx")
    for name, value in (("--side", side), ("--whole-side", whole_side)):
        if value % SIZE_STEP:
            raise ConfigError(f"{name} {value}: expected a multiple of {SIZE_STEP}")
    given = {
        "steps": steps, "batch": batch, "side_px": sample_side, "late_side_px": late_side, "rate": rate, "seed": seed,
        "rack_px": round(side / (1 + 2 * MARGIN)),
    }  # fmt: skip
    recipe = validate(Recipe, given, "training", ConfigError)
    require_packages()
    cores = threads or available_cores()
    folder = work if work is not None else out.with_name(f"{out.stem}-training")
    drawn = replace(read_labware_list(labware), variants=variants)
    sets = [(folder / "pictures", ImageSet(drawn, seed, picture_side, view), pictures)] if not images else []
    if unseen:
        judged = ImageSet(replace(drawn, held_out=True), seed + _UNSEEN_SEED, picture_side, view)
        sets.append((folder / "unseen", judged, unseen))
    for place, source, count in sets:
        _render(place, source, count, cores)
    files = labelled_sets(images or [folder / "pictures"])
    job = TrainingJob(files, out, folder, recipe, Looks(whole_side, side), cores, begin)
    with counted_progress("steps") as show:
        report = train_detector(
            job, labelled_set(folder / "unseen") if unseen else None, lambda done, _loss: show(done, steps)
        )
    say(f"{out}: {steps} steps on {len(files.images)} pictures; {folder / LOSS_FILE} shows the loss")
    if report is not None:
        show_report(report, f"{unseen} pictures on unseen grounds ({folder / SAMPLES_FILE})")


@app.command()
def evaluate(
    images: Annotated[Path, typer.Option(help="Folder of pictures.")],
    labels: Annotated[Path, typer.Option(help="Folder of YOLO label files, NAME.txt for NAME.jpg.")],
    classes: Annotated[Path, typer.Option(help="Class names of the labels, one a line.")],
    out: Annotated[Path, typer.Option(parser=named, metavar="PATH", help="Folder for the results.")],
    model: Annotated[Path | None, typer.Option(help="ONNX file; default: the bundled model.")] = None,
    model_classes: Annotated[Path | None, typer.Option(help="Class names of a model that names none.")] = None,
    map_: Annotated[
        list[str] | None,
        typer.Option(
            "--map",
            metavar="NAME=tube|rack|ignore",
            help="What a class of the labels is, else its name says; once for each class.",
        ),
    ] = None,
    score: Annotated[float, typer.Option(min=0, max=1, help="Score from which a box is an answer.")] = 0.3,
    threads: Annotated[int, typer.Option(min=0, help="0: onnxruntime's choice.")] = 0,
) -> None:
    """Judge a detector by labelled pictures: detection_summary.csv, detection_success.csv, worst.png."""
    import cv2
    import pandas as pd

    from tubepose.detection.bundled import bundled_model
    from tubepose.detection.evaluation import evaluate_detector, kinds_of
    from tubepose.detection.label_formats import read_class_names
    from tubepose.detection.labelled_images import find_labelled
    from tubepose.detection.yolo import YoloDetector
    from tubepose.report import write_aside, write_csv
    from tubepose.training.pictures import worst_sheet
    from tubepose.training.train import LOW_SCORE
    from tubepose_cli.show import counted_progress, say

    files = find_labelled(images, labels, classes)
    kinds = kinds_of(files.classes, _pairs(map_ or []))
    names = read_class_names(model_classes) if model_classes is not None else None
    detector = YoloDetector(model or bundled_model(), classes=names, score_threshold=LOW_SCORE, threads=threads or None)
    with counted_progress("pictures") as show:
        report = evaluate_detector(
            detector.detect_image, detector.words, files, kinds, score, lambda done: show(done, len(files.images))
        )
    write_csv(out / SUMMARY_FILE, report.summary)
    success = {"frames": report.n_frames, "successes": report.n_success, "success_rate": report.success_rate}
    write_csv(out / SUCCESS_FILE, pd.DataFrame([success]))
    with write_aside(out / WORST_FILE) as aside:
        cv2.imwrite(str(aside), worst_sheet(files, report, kinds, score))
    show_report(report, f"{len(files.images)} pictures, score {score:g} or more, overlap 0.5")
    say(f"{out}: {SUMMARY_FILE}, {SUCCESS_FILE}, {WORST_FILE}")


def _start_file(given: str | None) -> Path | None:
    """The file that a training starts from."""
    from tubepose.detection.bundled import bundled_model
    from tubepose.errors import ConfigError

    if given is None:
        return None
    if given == BUNDLED:
        return bundled_model()
    if not Path(given).is_file():
        raise ConfigError(
            f"--start {given}: no such file; expected {BUNDLED}, or the .onnx or checkpoint.pt of another training"
        )
    return Path(given)


def _render(out: Path, source: ImageSet, count: int, threads: int) -> None:
    """Render what is missing of a set, with progress."""
    from tubepose.training.images import write_images
    from tubepose_cli.show import counted_progress

    with counted_progress("pictures") as show:
        write_images(out, source, count, threads=threads, on_done=lambda done: show(done, count))


def show_report(report: DetectionReport, title: str) -> None:
    """The summary as a table, with the success rate under it."""
    from tubepose_cli.show import show_table

    table = report.summary.copy()
    for name in ("precision", "recall", "ap50", "ap50_95"):
        table[name] = [f"{value:.3f}" if value == value else "" for value in table[name]]
    note = f"all labelled tubes and racks found with the right class: {report.n_success} of {report.n_frames} pictures"
    show_table(table, title, [note])


def _pairs(given: Sequence[str]) -> dict[str, str]:
    from tubepose.errors import ConfigError

    pairs = {}
    for text in given:
        name, equals, kind = text.partition("=")
        if not equals:
            raise ConfigError(f"--map {text}: expected NAME=tube, NAME=rack or NAME=ignore")
        pairs[name.strip()] = kind.strip()
    return pairs


def read_labware_list(names: str) -> Stock:
    """Racks, tubes and printed caps of a comma-separated list of names and files, or of the whole catalogue."""
    from tubepose.errors import LabwareError
    from tubepose.labware import CapModel, RackModel, TubeModel, catalogue, read_labware
    from tubepose.labware.reading import LABWARE_SUFFIXES
    from tubepose.training.scenes import Stock
    from tubepose_cli.inputs import unknown_name

    known = catalogue()
    found: list[CapModel | RackModel | TubeModel] = []
    for name in (text.strip() for text in names.split(",")):
        if name == CATALOGUE:
            found += known.values()
        elif name in known:
            found.append(known[name])
        elif Path(name).suffix in LABWARE_SUFFIXES:
            found.append(read_labware(Path(name)))
        elif name:
            raise LabwareError(unknown_name("labware", name, known) + "; or give a .yaml or .json file")
    racks = tuple(item for item in found if isinstance(item, RackModel))
    tubes = tuple(item for item in found if isinstance(item, TubeModel))
    caps = tuple(item for item in found if isinstance(item, CapModel))
    if not racks or not tubes:
        raise LabwareError(f"--labware {names}: found {len(racks)} racks and {len(tubes)} tubes, expected one of each")
    return Stock(racks, tubes, caps)
