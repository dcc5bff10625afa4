"""`python -m nerfro.reconstruct`: the order of stages, kept and repeated results, and failures."""

import functools
import json
import os
import shlex
import shutil
import signal
import struct
import time
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import torch
from PIL import ExifTags, Image

import nerfro
from nerfro.capture import refinement
from nerfro.cli.calls import changed_settings
from nerfro.cli.overrides import as_overrides
from nerfro.core.errors import NerfroError
from nerfro.data import image_files
from nerfro.data.base import Views
from nerfro.data.capture import Capture
from nerfro.data.masks import find_mask
from nerfro.evaluation.results import EvaluationResult, RunMetrics, ViewScores, read_metrics_json
from nerfro.evaluation.scoring import ImageMetrics
from nerfro.files.images import load_png, save_png
from nerfro.files.reading import open_image
from nerfro.pipeline import reconstruct as chain
from nerfro.pipeline.hypotheses import Hypothesis, hypotheses, worth_a_trial
from nerfro.pipeline.stage import terminated_in_one_line
from nerfro.pipeline.trials import Trial, decide, draw_trials
from nerfro.poses import collection
from nerfro.poses.options import CalibrateConfig
from nerfro.rendering.scene_file import Provenance, SceneFile, read_scene_file
from nerfro.report.summary import SummaryConfig
from nerfro.training.run import Run
from nerfro.viewing.exports import ExportConfig
from tests.ball_photographs import RECONSTRUCTION, RECONSTRUCTION_TRAINING, save_with_masks
from tests.cameras_at import cameras_at, random_poses
from tests.conftest import Runner, refused, weights_of


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """Three photographs; a folder `silhouettes` beside theirs has a mask of each."""
    for i in range(3):
        save_png(tmp_path / "photos" / f"IMG_{i}.png", torch.full((8, 8, 3), 0.2 * i))
        mask = tmp_path / "silhouettes" / f"IMG_{i}.png"
        save_png(mask, torch.ones(8, 8, 3))
        os.utime(mask, (0, 0))
    return tmp_path / "photos"


def test_links_to_deleted_photographs_are_removed(photos: Path, tmp_path: Path) -> None:
    collection.link_photographs(photos, photos.parent / "silhouettes", tmp_path / "out")
    (photos / "IMG_1.png").unlink()
    collection.link_photographs(photos, photos.parent / "silhouettes", tmp_path / "out")
    assert sorted(file.name for file in (tmp_path / "out" / "images").iterdir()) == ["IMG_0.png", "IMG_2.png"]
    assert len(list((tmp_path / "out" / "masks").iterdir())) == 3


def test_photographs_that_differ_in_their_extension_are_refused(photos: Path, tmp_path: Path) -> None:
    Image.new("RGB", (8, 8)).save(photos / "IMG_1.jpg")
    refused("several images named IMG_1", collection.link_photographs, photos, None, tmp_path / "out")


def test_photograph_beside_its_heic_original_is_used(photos: Path, tmp_path: Path) -> None:
    (photos / "IMG_1.heic").touch()
    collection.link_photographs(photos, None, tmp_path / "out")
    assert {file.name for file in (tmp_path / "out" / "images").iterdir()} == {f"IMG_{i}.png" for i in range(3)}


def _lying(file: Path) -> None:
    """Write a photograph with an EXIF orientation, which is converted."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    Image.new("L", (8, 8)).save(file, exif=exif.tobytes())


def test_links_follow_their_folders_until_the_calibration(photos: Path, tmp_path: Path) -> None:
    masks = photos.parent / "silhouettes"
    more = {name: tmp_path / name for name in ("more_photos", "more_masks")}
    for folder in more.values():
        save_png(folder / "IMG_0.png", torch.ones(8, 8, 3))
    out = tmp_path / "out"
    collection.link_photographs(photos, masks, out)
    collection.link_photographs(more["more_photos"], more["more_masks"], out)
    assert (out / "images" / "IMG_0.png").resolve() == more["more_photos"] / "IMG_0.png"
    assert (out / "masks" / "IMG_0.png").resolve() == more["more_masks"] / "IMG_0.png"
    (out / "calibration.json").write_text("{}")  # the poses belong to the photographs that were calibrated
    collection.link_photographs(photos, masks, out)
    assert (out / "images" / "IMG_0.png").resolve() == more["more_photos"] / "IMG_0.png"
    assert (out / "masks" / "IMG_0.png").resolve() == masks / "IMG_0.png"


def test_other_photographs_are_named_and_no_file_is_deleted(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Converted photographs may be the only copy, and an own photograph may have any name."""
    out = tmp_path / "out"
    for name in ("lying", "removed"):
        _lying(photos / f"{name}.jpg")
    collection.link_photographs(photos, None, out)
    (out / "images" / "._hidden.jpg").touch()
    save_png(out / "images" / "mine.png", torch.ones(8, 8, 3))
    before = sorted((out / "images").iterdir())
    capsys.readouterr()
    (photos / "removed.jpg").unlink()
    later = time.time_ns() + 10**9
    os.utime(photos / "lying.jpg", ns=(later, later))
    collection.link_photographs(photos, None, out)
    printed = capsys.readouterr().out
    assert "not in" in printed
    assert "mine.png, removed.jpg" in printed
    assert "older than those in" in printed
    assert ": lying.jpg" in printed
    collection.link_photographs(out / "images", None, out)
    assert sorted((out / "images").iterdir()) == before


@pytest.mark.parametrize("num_colours", [1, 3])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_photographs_of_every_depth_become_upright_without_other_changes(
    suffix: str, dtype: type, num_colours: int, tmp_path: Path
) -> None:
    slope = np.linspace(0, 1, 24 * 16).reshape(16, 24)
    levels = np.rint(np.iinfo(dtype).max * slope).astype(dtype)
    levels = levels if num_colours == 1 else np.repeat(levels[..., None], 3, -1)
    (tmp_path / "photos").mkdir()
    file = tmp_path / "photos" / f"a{suffix}"
    if suffix == ".tif":
        photometric = "rgb" if num_colours == 3 else "minisblack"
        tifffile.imwrite(file, levels, photometric=photometric, extratags=[(274, "H", 1, 6, True)])
    else:
        exif = Image.Exif()
        exif[ExifTags.Base.Orientation] = 6
        _, content = cv2.imencode(".png", levels)
        chunk = b"eXIf" + exif.tobytes().removeprefix(b"Exif\0\0")
        chunk = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
        file.write_bytes(content.tobytes()[:33] + chunk + content.tobytes()[33:])  # after the header of 33 bytes
    collection.link_photographs(tmp_path / "photos", None, tmp_path / "out")
    found = image_files.read_levels(tmp_path / "out" / "images" / "a.jpg")
    np.testing.assert_allclose(found, np.repeat(255 * np.rot90(slope, -1)[..., None], 3, -1), atol=4)


@pytest.mark.parametrize("suffix", [".JPG", ".heic"])
def test_photographs_of_a_phone_become_upright_and_keep_their_masks(suffix: str, tmp_path: Path) -> None:
    if suffix == ".heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    lying, exif = Image.new("RGB", (96, 64), (200, 30, 30)), Image.Exif()
    lying.paste((30, 30, 200), (48, 0, 96, 64))
    exif[ExifTags.Base.Orientation] = 6  # the left edge is on top
    exif[ExifTags.Base.Model] = "telephone"
    (tmp_path / "photos").mkdir()
    lying.save(tmp_path / "photos" / f"IMG_1{suffix}", exif=exif.tobytes())
    (tmp_path / "masks").mkdir()
    Image.new("L", (64, 96)).save(tmp_path / "masks" / f"IMG_1{suffix}.png")  # as COLMAP names masks
    collection.link_photographs(tmp_path / "photos", tmp_path / "masks", tmp_path / "out")
    assert find_mask(tmp_path / "out", tmp_path / "out" / "images" / "IMG_1.jpg") is not None
    with open_image(tmp_path / "out" / "images" / "IMG_1.jpg") as (upright, _):
        assert upright.size == (64, 96)
        assert upright.getexif()[ExifTags.Base.Model] == "telephone"
        top, bottom = (upright.getpixel((32, row)) for row in (12, 84))
    assert top == pytest.approx((200, 30, 30), abs=12)
    assert bottom == pytest.approx((30, 30, 200), abs=12)


class Pretended:
    """Stages that do nothing but write their results, a second after each other by their files' times.

    Attributes:
        ran: name of each stage with the options of its command.
        ends: how stages end that do not reach their end, by name.
    """

    def __init__(self, out: Path) -> None:
        self.out = out
        self.surroundings: str | None = "far"
        self.doubts, self.unsupported, self.medium = list[str](), list[str](), {"type": "object"}
        self.vessel = {"wall": 0.01}
        self.psnr = {"straight": 20.0, "unknown": 22.0, "glass": 21.0, "glass_room": 21.0}  # by experiment
        self.lpips = dict[str, float]()  # of the crop; without an experiment, its crop is too small
        self.ran: list[tuple[str, list[str]]] = []
        self.ends: dict[str, BaseException | None] = {}
        self._now = time.time() - 1000

    @property
    def names(self) -> list[str]:
        return [name for name, _ in self.ran]

    def write(self, file: str, content: object = None) -> None:
        path = self.out / file
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))
        self._now += 1
        os.utime(path, (self._now, self._now))

    def begin(self, name: str, options: list[str]) -> bool:
        """Record a stage; returns whether it reaches its end."""
        self.ran.append((name, options))
        if self.ends.get(name) is not None:
            raise self.ends[name]
        return name not in self.ends

    def calibrate(self, options: CalibrateConfig) -> Capture:
        if self.begin("calibrate", as_overrides(changed_settings(options))):
            self.write("transforms_train.json")
            self.write("calibration.json", {})
        return Capture(options.out)

    def segment(self, capture: Capture, overrides: list[str]) -> Capture:
        if self.begin("mask", [*capture.overrides, *overrides]):
            self.write("masks.png")
        return capture

    def preprocess(self, capture: Capture, overrides: list[str]) -> SceneFile:
        if self.begin("preprocess", [*capture.overrides, *overrides]):
            bodies = {"object": {"mesh": "mesh.ply", "ior": 1.4}}
            self.write("surface/mesh.ply")
            self.write("surface/scene.json", {
                "data": {"type": "opencv", "root": ".."}, "medium": self.medium, "bodies": bodies,
                "vessel": self.vessel, "surroundings": self.surroundings, "photograph": [512, 384],
                "provenance": {"doubts": self.doubts, "unsupported": self.unsupported},
            })  # fmt: skip
        file = self.out / "surface" / "scene.json"
        return read_scene_file(file) if file.is_file() else SceneFile()

    def train_scene(self, scene: SceneFile, options: list[str]) -> Run:
        folder = options[-1 - (options[-1] == "ckpt_path=last")].removeprefix(f"hydra.run.dir={self.out}/")
        self.write(f"{folder}/config.yaml")
        if self.begin("train", options):
            experiment = next(text.split("=")[1] for text in options if text.startswith("+experiment="))
            psnr, crop = self.psnr[experiment], {"lpips": self.lpips.get(experiment)}
            view = {"name": "val_000", "psnr": psnr, "regions": {"mask": {"psnr": psnr - 2}, "crop": crop}}
            self.images(f"{folder}/images", experiment)
            self.write(
                f"{folder}/metrics.json", {"views": [view], "steps": 1, "train_seconds": 1, "rays_per_second": 1}
            )
        return Run(self.out / folder, read_metrics_json(self.out / folder / "metrics.json"))

    def images(self, folder: str, experiment: str) -> None:
        """Write the rendered image: the level of grey tells the experiment."""
        level = list(self.psnr).index(experiment) / 4
        save_png(self.out / folder / "val_000.png", torch.full((40, 60, 3), level))

    def validation_views(self, folder: Path) -> Views:
        """A white photograph, of which the object covers one pixel."""
        masks = torch.zeros(1, 40, 60)
        masks[0, 8, 50] = 1
        cameras = cameras_at(random_poses(1), 60, 40, 50.0)
        return Views(cameras, torch.ones(1, 40, 60, 3), masks, ["IMG_0.png"])

    def summarize(self, options: SummaryConfig) -> None:
        if self.begin("summary", as_overrides(changed_settings(options))):
            self.write("report/report.html")

    def export(self, options: ExportConfig) -> None:
        if self.begin("export", as_overrides(changed_settings(options))):
            self.write("page.html")


@pytest.fixture
def pretended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Pretended:
    made = Pretended(tmp_path / "out")
    for name in ("calibrate", "segment", "preprocess", "train_scene", "validation_views", "summarize", "export"):
        monkeypatch.setattr(chain, name, getattr(made, name))
    return made


@pytest.fixture
def reconstruct(run_here: Runner, pretended: Pretended, photos: Path) -> Runner:
    """Reconstruct the photographs and their masks by pretended stages."""
    given = f"images={photos}", f"masks={photos.parent / 'silhouettes'}", f"out={pretended.out}"
    return functools.partial(run_here, "reconstruct", *given)


TRIALS = ["train"] * 3  # straight rays, solid body, vessel
ALL = ["calibrate", "preprocess", *TRIALS, "train", "summary", "export"]


def test_photographs_pass_every_stage_once(
    reconstruct: Runner, pretended: Pretended, photos: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = "medium.resolution=64", "train=trainer.max_steps=3 logger=none", "preprocess=keep=1"
    done = reconstruct("data.far=9", *options)
    assert pretended.names == ALL
    links = sorted(path.relative_to(pretended.out).as_posix() for path in pretended.out.glob("*/IMG*"))
    assert links == [f"{folder}/IMG_{i}.png" for folder in ("images", "masks") for i in range(3)]
    calibrate, preprocess, straight, solid, vessel, train, *_ = (options for _, options in pretended.ran)
    assert "target=colmap" in calibrate
    data = ["data=opencv", f"data.root={pretended.out}", "data.far=9"]
    assert preprocess[:4] == [*data, "medium.resolution=64"]
    assert preprocess[-1] == "keep=1"
    scene = f"scene={pretended.out / 'surface' / 'scene.json'}"
    assert train == ["+experiment=unknown", "camera.exposure=true", "data.downscale=2",
                     "trainer.max_steps=3", "logger=none", f"hydra.run.dir={pretended.out / 'run'}"]  # fmt: skip
    assert f"python -m nerfro.train {scene} {' '.join(train)}" in done.out
    trials = {"straight_rays": straight, "solid_body": solid, "vessel": vessel}
    for folder, trial in trials.items():
        assert {"evaluation.split=val", "trainer.max_time=null", "camera.exposure=true"} <= set(trial)
        assert trial[-1] == f"hydra.run.dir={pretended.out / 'trials' / folder}"
    assert straight[0] == "+experiment=straight"
    assert solid[:3] == train[:3]
    assert len({option.partition("=")[0] for option in solid}) == len(solid)  # no option is given twice
    assert vessel[:2] == ["+experiment=glass", "medium=vessel"]
    run = nerfro.reconstruct(["data.far=9"], images=photos, masks=photos.parent / "silhouettes", out=pretended.out)
    assert (run.folder, run.scores.steps) == (pretended.out / "run", 1)
    assert pretended.names == ALL
    printed = capsys.readouterr().out
    assert printed.count(" is kept (delete it to repeat the stage)") == len(ALL)
    assert f"train: done; {pretended.out / 'run'} is kept" in printed, "without its configuration, it starts again"
    assert printed.endswith(f"report: {pretended.out}/report/report.html\npage: {pretended.out}/page.html\n")


@pytest.mark.slow
def test_changed_inputs_repeat_the_dependent_stages(reconstruct: Runner, pretended: Pretended) -> None:
    reconstruct()
    pretended.write("../silhouettes/IMG_1.png")
    done = reconstruct()
    assert pretended.names == [*ALL, *ALL[1:]]
    # The training that was there is another one's.
    assert (pretended.out / "run_1" / "metrics.json").is_file()
    assert f"which is kept as {pretended.out / 'run_1'}" in done.out
    assert "ckpt_path=last" not in pretended.ran[-3][1]
    (pretended.out / "report" / "report.html").unlink()
    reconstruct()
    assert pretended.names == [*ALL, *ALL[1:], "summary"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("doubts", "psnr", "chosen", "printed"),
    [
        ([], {"straight": 21.8}, "straight rays", "bent rays is not higher by 0.25 dB: the surface or the index"),
        ([], {"straight": 21.7}, "solid body", "training continues with: solid body"),
        ([], {"glass": 23.0}, "vessel", "training continues with: vessel"),
        (["shallow"], {"straight": 23.0}, "straight rays", "the photographs do not determine its index"),
        (["shallow"], {}, "solid body, water", "training continues with: solid body, water"),
    ],
)
def test_training_continues_with_the_hypothesis_that_the_validation_photographs_prefer(
    reconstruct: Runner, pretended: Pretended, doubts: list[str], psnr: dict[str, float], chosen: str, printed: str
) -> None:
    pretended.doubts = doubts
    pretended.psnr |= psnr
    done = reconstruct("trial_steps=70")
    assert printed in done.out
    *trials, train = [options for name, options in pretended.ran if name == "train"]
    best = next(trial for trial in trials if Hypothesis(chosen, []).folder in trial[-1])
    assert best[: len(train) - 1] == train[:-1], "the same options as in its trial"
    assert f"trainer.max_steps={88 if chosen == 'straight rays' else 70}" in best
    learned = [option for trial in trials for option in trial if option.startswith("medium.ior=")]
    assert learned == ["medium.ior=1.333", "medium.ior=1.52"] * bool(doubts), "an index in doubt is never known"


@pytest.mark.parametrize(
    ("doubts", "unsupported", "tried"),
    [
        ([], ["vessel", "solid body"], ["straight_rays", "vessel", "solid_body"]),
        ([], ["vessel"], ["straight_rays", "solid_body", "vessel"]),
        (["shallow"], ["solid body, water", "vessel"], ["straight_rays", "solid_body_glass", "vessel"]),
        (["shallow"], ["solid body, glass", "vessel", "solid body, water"],
         ["straight_rays", "solid_body_glass", "vessel"]),
        (["shallow"], [], ["straight_rays", "solid_body_water", "solid_body_glass", "vessel"]),
    ],
)  # fmt: skip
def test_pixels_of_the_object_order_the_trials_and_never_remove_the_last_body_or_vessel(
    doubts: list[str], unsupported: list[str], tried: list[str]
) -> None:
    scene = SceneFile(vessel={"wall": 0.01}, surroundings="far", provenance=Provenance(doubts=doubts))
    assert [trial.folder for trial in worth_a_trial(hypotheses(scene), unsupported)] == tried


@pytest.mark.slow
@pytest.mark.parametrize(
    ("choice", "experiment"), [("straight", "straight"), ("solid", "unknown"), ("vessel", "glass")]
)
def test_given_hypothesis_is_trained_without_trials(
    pretended: Pretended, photos: Path, choice: str, experiment: str
) -> None:
    masks = photos.parent / "silhouettes"
    nerfro.reconstruct(images=photos, masks=masks, out=pretended.out, hypothesis=choice)
    assert pretended.names == ["calibrate", "preprocess", "train", "summary", "export"]
    train = pretended.ran[2][1]
    assert train[0] == f"+experiment={experiment}"
    assert ("medium=vessel" in train) == (choice == "vessel")


@pytest.mark.slow
def test_run_of_an_unknown_hypothesis_is_kept_under_another_name(reconstruct: Runner, pretended: Pretended) -> None:
    reconstruct("train=+experiment=glass_room")
    assert "kept as" not in reconstruct("train=+experiment=glass_room logger=none").out
    (pretended.out / "hypothesis.json").unlink()
    assert f"kept as {pretended.out / 'run_1'}" in reconstruct("hypothesis=vessel").out
    assert pretended.ran[-3][1][:2] == ["+experiment=glass", "medium=vessel"]


@pytest.mark.slow
def test_given_solid_body_of_unknown_index_is_tried_with_common_indices(
    reconstruct: Runner, pretended: Pretended
) -> None:
    pretended.doubts = ["shallow"]
    reconstruct("hypothesis=solid")
    trials = [Path(options[-1]).name for name, options in pretended.ran if name == "train"]
    assert trials == ["solid_body_water", "solid_body_glass", "run"]


def test_impossible_hypothesis_is_refused(reconstruct: Runner, pretended: Pretended) -> None:
    assert "both determine the training" in reconstruct(
        "hypothesis=solid", "train=+experiment=glass", code=1
    ).error  # fmt: skip
    assert pretended.names == []
    pretended.vessel = {}
    refused = reconstruct("hypothesis=vessel", code=1).error
    assert "which allow hypothesis=straight or hypothesis=solid; for a vessel without fitted lengths" in refused
    assert "straight" in reconstruct("hypothesis=opaque", code=1).error


def trial_with_scores(name: str, psnr: float, lpips: float | None) -> Trial:
    scores = ViewScores("val_000", {"psnr": psnr}, {"mask": {"psnr": psnr - 2}, "crop": {"lpips": lpips}})
    return Trial(Hypothesis(name, []), Run(Path(name), RunMetrics(EvaluationResult((scores,)))))


@pytest.mark.parametrize(
    ("psnr", "lpips", "best", "other"),
    [
        ({"straight": 27.1, "glass": 26.2}, {"glass": 0.240}, "vessel", "straight rays"),
        ({"straight": 27.1, "glass": 26.2}, {"glass": 0.244}, "straight rays", None),
        ({"straight": 27.1, "glass": 26.0}, {"glass": 0.240}, "straight rays", "vessel"),
        ({"straight": 27.1, "unknown": 27.0, "glass": 27.2}, {"unknown": 0.2, "glass": 0.1}, "vessel", "straight rays"),
        ({"straight": 26.0, "glass": 27.1}, {"glass": 0.240}, "vessel", None),
        ({"straight": 26.0, "glass": 27.1}, {"glass": 0.250}, "vessel", "straight rays"),
        ({"straight": 22.0, "unknown": 25.0, "glass": 23.0}, {"glass": 0.2}, "solid body", "vessel"),
    ],
)  # fmt: skip
def test_decision_weighs_psnr_and_lpips(
    capsys: pytest.CaptureFixture[str], psnr: dict, lpips: dict, best: str, other: str | None
) -> None:
    names = {"straight rays": "straight", "solid body": "unknown", "vessel": "glass"}
    psnr, lpips = {"unknown": 22.0, "glass": 21.0} | psnr, {"straight": 0.244, "unknown": 0.3} | lpips
    trials = [trial_with_scores(name, psnr[key], lpips[key]) for name, key in names.items()]
    assert decide(trials, ["images=PHOTOS", "hypothesis=null"]).hypothesis.name == best
    printed = capsys.readouterr().out
    assert f"training continues with: {best}\n" in printed
    assert ("PSNR and LPIPS disagree" in printed) == (other is not None)
    is_by_lpips = best == "vessel" and psnr["glass"] < psnr["straight"] + 0.25
    assert ("LPIPS decides" in printed) == is_by_lpips
    if other is not None:
        line, command = printed.splitlines()[-2:]
        for name in (best, other):
            psnr_of, lpips_of = psnr[names[name]], lpips[names[name]]
            assert f"{name} {psnr_of:.2f} dB (object {psnr_of - 2:.2f} dB), LPIPS of the crop {lpips_of:.3f}" in line
        assert line.endswith(f"to continue with {other}:")
        assert command == f"  python -m nerfro.reconstruct images=PHOTOS hypothesis={other.split()[0]}"


def test_without_lpips_of_every_hypothesis_psnr_alone_decides(capsys: pytest.CaptureFixture[str]) -> None:
    trials = [trial_with_scores("straight rays", 27.1, 0.244), trial_with_scores("vessel", 26.2, None)]
    assert decide(trials, []) is trials[0]
    printed = capsys.readouterr().out
    assert "PSNR alone decides, because LPIPS of the crop is not available: a crop is smaller than 31 pixels" in printed
    assert "disagree" not in printed


@pytest.mark.slow
def test_printed_command_continues_with_the_other_hypothesis(
    run_here: Runner, reconstruct: Runner, pretended: Pretended
) -> None:
    """All bodies are unsupported by the pixels of the object; the picture is in the reports of both runs."""
    pretended.unsupported = ["vessel", "solid body"]
    pretended.psnr |= {"straight": 27.1, "unknown": 22.0, "glass": 26.2}
    pretended.lpips = {"straight": 0.244, "unknown": 0.3, "glass": 0.24}
    printed = reconstruct().out
    trials = [Path(options[-1]).name for name, options in pretended.ran if name == "train"]
    assert trials == ["straight_rays", "vessel", "solid_body", "run"]
    picture = pretended.out / "trials" / "hypotheses.png"
    assert f"each hypothesis beside photographs: {picture}\n" in printed
    shown = load_png(picture)
    for column, level in enumerate((1.0, 0.0, 0.5, 0.25)):  # photograph, straight rays, vessel, solid body
        assert shown[100, 276 * column + 100].tolist() == pytest.approx([level] * 3, abs=0.003)
    command = next(line for line in printed.splitlines() if line.endswith("hypothesis=straight"))
    other = run_here(*shlex.split(command.replace("python -m nerfro.", ""))).out
    assert f"kept as {pretended.out / 'run_1'}" in other
    *_, vessel, summary, _, straight, summary_of_other, _ = (options for _, options in pretended.ran)
    assert (vessel[0], straight[0]) == ("+experiment=glass", "+experiment=straight")
    assert "ckpt_path=last" not in straight
    assert f"pictures=[{picture}]" in summary
    assert f"pictures=[{picture}]" in summary_of_other


def scored_trial(name: str, folder: Path, images: torch.Tensor, views: Views) -> Trial:
    """A trial that rendered the images, scored by all metrics."""
    metrics, scores = ImageMetrics(), []
    for view, image in enumerate(images):
        save_png(folder / "images" / f"val_{view:03d}.png", image)
        scores.append(metrics.score(f"val_{view:03d}", image, views.images[view], views.masks[view]))
    return Trial(Hypothesis(name, []), Run(folder, RunMetrics(metrics.result(scores))))


def test_picture_shows_every_hypothesis_beside_three_photographs(tmp_path: Path) -> None:
    size, num_views = 64, 5
    masks = torch.zeros(num_views, size, size)
    masks[1:, 30:34, 40:60] = 1
    masks[4, 30:34, 20:60] = 1  # crops of 38 x 41 and of 38 x 61 pixels
    cameras, names = cameras_at(random_poses(num_views), size, size, 50.0), [f"IMG_{view}" for view in range(num_views)]
    levels = (0.1 * torch.arange(num_views))[:, None, None, None].expand(-1, size, size, 3)
    views = Views(cameras, levels, masks, names)
    trials = [scored_trial(name, tmp_path / name, levels + 0.1 * number, views)
              for number, name in enumerate(("straight rays", "solid body", "vessel"), start=1)]  # fmt: skip
    picture = torch.from_numpy(np.array(draw_trials(trials, views))).float() / 255
    width, height, gap, line = 305, 190, 6, 22  # crops are enlarged five times
    assert picture.shape[:2] == (line + 3 * (height + line + gap) + 2 * line - gap, 4 * (width + gap) - gap)
    for row, view in enumerate((1, 3, 4)):  # view 0 does not show the object
        top = line + row * (height + line + gap)
        for column in range(4):
            cell = picture[top : top + height, column * (width + gap) :][:, :width]
            torch.testing.assert_close(cell, torch.full_like(cell, 0.1 * (view + column)), atol=0.003, rtol=0)
    below = picture[-3 * line :]
    assert all((below[:, column * (width + gap) :][:, :width] < 0.3).any() for column in range(4))
    (tmp_path / "vessel" / "images" / "val_003.png").unlink()
    refused("val_003.png", draw_trials, trials, views)


@pytest.mark.slow
def test_missing_picture_of_the_hypotheses_is_a_warning(
    reconstruct: Runner, pretended: Pretended, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(folder: Path) -> Views:
        raise NerfroError("the photographs have moved")

    monkeypatch.setattr(chain, "validation_views", fail)
    done = reconstruct()
    assert "the hypotheses were not drawn: the photographs have moved" in done.out
    assert not any(option.startswith("pictures=") for option in dict(pretended.ran)["summary"])


@pytest.mark.slow
def test_interrupted_training_is_resumed(reconstruct: Runner, pretended: Pretended) -> None:
    pretended.ends["train"] = KeyboardInterrupt()
    stopped = reconstruct("trial_steps=0", code=130)
    assert stopped.err == "nerfro: interrupted; train is incomplete; repeat the same command to continue\n"
    pretended.ends.clear()
    reconstruct("trial_steps=0")
    assert pretended.names == ["calibrate", "preprocess", "train", "train", "summary", "export"]
    assert "ckpt_path=last" not in pretended.ran[2][1]
    assert pretended.ran[3][1] == [*pretended.ran[2][1], "ckpt_path=last"]


def test_failed_stage_is_named_and_later_stages_do_not_run(reconstruct: Runner, pretended: Pretended) -> None:
    pretended.ends["preprocess"] = NerfroError("the masks are empty")
    failed = reconstruct(code=1).error
    assert failed.startswith("nerfro: error: preprocess failed: the masks are empty; correct the input, ")
    assert "set preprocess='OPTIONS'" in failed
    assert pretended.names == ["calibrate", "preprocess"]
    pretended.ends["preprocess"] = None
    assert "scene.json was not written" in reconstruct(code=1).error
    assert pretended.names == ["calibrate", "preprocess", "preprocess"]


@pytest.mark.slow
def test_failed_page_does_not_fail_the_reconstruction(reconstruct: Runner, pretended: Pretended) -> None:
    pretended.ends["export"] = NerfroError("the index varies in space")
    done = reconstruct("trial_steps=0")
    assert "nerfro: warning: no page was written: export failed: the index varies in space; " in done.out
    assert "correct the input, or run the printed command" in done.out, "no option has settings of the export"
    assert done.out.endswith(f"report: {pretended.out}/report/report.html\n")


@pytest.mark.slow
def test_scene_file_selects_the_experiment(run_here: Runner, pretended: Pretended, tiny_scene: Path) -> None:
    asked = "data=blender", f"data.root={tiny_scene}", "outlines={r_0:[1,2,9,9]}", "medium=vessel", "medium.wall=0.1"
    pretended.surroundings, pretended.doubts, pretended.medium = "near", ["shallow"], {"type": "vessel", "wall": 0.1}
    failed = run_here("reconstruct", *asked, f"out={pretended.out}", code=1).error
    assert pretended.names == ["mask"], "its sheet lies in the data's folder"
    assert "mask failed" in failed
    run_here("reconstruct", *asked[:2], *asked[3:], f"out={pretended.out}")
    assert pretended.names[1:] == ["preprocess", "train", "train", "train", "summary", "export"]
    assert pretended.ran[1][1][:4] == ["data=blender", f"data.root={tiny_scene}", "medium=vessel", "medium.wall=0.1"]
    assert pretended.ran[4][1][:2] == ["+experiment=glass_room", "batches.subdivision.side=1"]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ((), "set out=FOLDER, and images=PHOTOS"),
        (("images=PHOTOS", "data.root=PHOTOS"), "images= and video= are for photographs without poses"),
        (("images=PHOTOS", "video=PHOTOS"), "images= and video= are both given"),
        (("video=PHOTOS/none.mp4",), "none.mp4 does not exist; give a video file, or images=FOLDER for photographs"),
        (("images=PHOTOS",), "the photographs have no masks; add mask='view=true' to draw the outline"),
        (("data.root=PHOTOS", "masks=PHOTOS"), "masks= needs images="),
        (("images=PHOTOS/none",), "none is not a folder; it should hold the images"),
        (("images=PHOTOS", "train=--help"), "train='--help': --help is a flag; give options of the form key=value"),
        (("images=PHOTOS", "train=trainer.max_stepz=3"), "trainer.max_stepz is not a setting; did you mean max_steps?"),
        (("images=PHOTOS", "train=+experiment=glas"), "experiment=glas does not exist; did you mean glass?"),
        (("images=PHOTOS", "preprocess=foo=1"), "foo is not a setting; known: "),
        (("images=PHOTOS", "mask=views=true"), "views is not a setting; did you mean view?"),
        (("images=PHOTOS", 'train="name=\'abc"'), '"name=\'abc" has a quotation mark that is not closed'),
        (("images=PHOTOS/film",), "film holds no image, but .mp4 files; allowed are"),
        (("images=PHOTOS/two",), "2 photographs do not determine poses and shape"),
        (("images=PHOTOS", "outlines=none.json"), "none.json does not exist"),
    ],
)
def test_contradictory_options_are_refused(
    run_here: Runner, pretended: Pretended, photos: Path, overrides: tuple[str, ...], message: str
) -> None:
    (photos / "film").mkdir()
    (photos / "film" / "CLIP.mp4").touch()
    (photos / "two").mkdir()
    for i in range(2):
        shutil.copy(photos / f"IMG_{i}.png", photos / "two")
    options = [f"out={pretended.out}", *(text.replace("PHOTOS", str(photos)) for text in overrides)]
    assert message in run_here("reconstruct", *options, code=1).error
    assert pretended.names == []


def test_sigterm_ends_a_stage_like_ctrl_c() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), terminated_in_one_line():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) == before


def test_unknown_surroundings_are_refused_before_training(reconstruct: Runner, pretended: Pretended) -> None:
    pretended.surroundings = None
    refused = reconstruct("trial_steps=0", code=1).error
    assert "scene.json does not tell whether the surroundings are near" in refused
    assert pretended.names == ["calibrate", "preprocess"]
    reconstruct("trial_steps=0", "train=+experiment=glass_room")


@pytest.mark.slow
def test_posed_photographs_of_a_ball_become_a_scene(
    run_here: Runner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All stages but that of poses; each gives the same result alone, and leaves nothing behind."""
    data, out = tmp_path / "ball", tmp_path / "out"
    save_with_masks(data)
    short = refinement.RefinementSettings((refinement.DescentStage(20, 1e-4, (3.0, 1.0)),), 1000)
    monkeypatch.setattr(refinement, "RefinementSettings", lambda: short)
    train = [*RECONSTRUCTION_TRAINING, "trainer.max_steps=2", "phase.background.steps=100"]
    asked = [*RECONSTRUCTION, f"data.root={data}", f"out={out}", "medium.cache=false", "trial_steps=2"]
    asked.append(f"train={' '.join(train)}")
    before = torch.initial_seed(), signal.getsignal(signal.SIGTERM)
    done = run_here("reconstruct", *asked)
    index = json.loads((out / "surface" / "index.json").read_text())
    assert index["ior"] == [pytest.approx(1.45, rel=0.02)]
    assert 0 < index["standard_error"][0] < 0.02
    scene = json.loads((out / "surface" / "scene.json").read_text())
    assert scene["surroundings"] == "far"
    assert scene["bodies"] == {"object": {"mesh": "mesh.ply", "ior": round(index["ior"][0], 4)}}
    assert scene["provenance"]["standard_error"] == index["standard_error"]
    assert scene["provenance"]["unsupported"] == ["vessel"]
    assert (out / "surface" / "refinement.json").is_file()
    assert json.loads((out / "run" / "metrics.json").read_text())["steps"] == 2
    assert (out / "report" / "report.html").is_file()
    assert "training continues with: " in done.out
    assert (out / "page.html").is_file()
    assert f"each hypothesis beside photographs: {out / 'trials' / 'hypotheses.png'}" in done.out
    # Surface, three trials, training, report and page.
    assert run_here("reconstruct", *asked).out.count(" is kept (delete it to repeat the stage)") == 7
    assert (torch.initial_seed(), signal.getsignal(signal.SIGTERM)) == before
    command = next(line for line in done.out.splitlines() if line.endswith(f"hydra.run.dir={out}/run"))
    run_here("train", *shlex.split(command)[4:], f"hydra.run.dir={tmp_path / 'alone'}")
    chained, separate = weights_of(out / "run"), weights_of(tmp_path / "alone")
    assert all(torch.equal(chained[name], separate[name]) for name in chained)
    assert json.loads((out / "run" / "run.json").read_text())["command"].split()[1:3] == ["-m", "nerfro.train"]
