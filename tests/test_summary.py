import functools
import json
import os
import re
import statistics
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf

from nerfro.evaluation.image_metrics import image_metrics
from nerfro.evaluation.results import EvaluationResult, RunMetrics, ViewScores, write_metrics_json
from nerfro.evaluation.tables import Table
from nerfro.files.images import save_png
from nerfro.registry.registration import find
from nerfro.report.comparison import compare, to_table
from nerfro.report.runs import find_runs
from nerfro.training.run_folder import LAST_CHECKPOINT, record
from tests.conftest import Runner, refused

PAPER = image_metrics(["psnr", "ssim", "lpips"])
FIELD = {"_target_": "nerfro.fields.nerf.NerfField", "width": 64, "scale": 1.0}


def write_run(
    folder: Path,
    name: str,
    psnr: float,
    seed: int = 0,
    root: str = "scenes/torus",
    size: int = 16,
    max_time: str | None = "00:00:04:00",
    max_steps: int = -1,
    field: dict | None = None,
    lpips: float | None = 0.1,
) -> Path:
    """A run folder as nerfro.train leaves it, with grey pictures."""
    config = {
        "name": name,
        "seed": seed,
        "data": {"_target_": find("data", "blender").target, "root": root, "near": 2.0, "far": 6.0, "alpha": "drop"},
        "medium": {"mesh": f"{root}/mesh.ply", "cache": seed == 0},
        "field": field or FIELD,
        "batches": {"size": 512},
        "evaluation": {"split": "test", "every": 10 + seed},
        "trainer": {"max_time": max_time, "max_steps": max_steps, "accelerator": "cpu", "devices": 1},
    }
    record(folder, OmegaConf.create(config))
    others = {name: None if metric.maps else 0.5 for name, metric in image_metrics().items()}
    rows = tuple(
        ViewScores(f"test_{i:03d}", {**others, "psnr": psnr + i - 0.5, "ssim": psnr / 40, "lpips": lpips})
        for i in range(2)
    )
    result = EvaluationResult(rows, {} if lpips is not None else {"lpips": "no network"})
    write_metrics_json(folder / "metrics.json", RunMetrics(result, 1500, 240.0, 81000.0))
    for row in rows:
        save_png(folder / "images" / f"{row.name}.png", torch.full((size, size, 3), 0.5))
    return folder


def tables(place: Path) -> list[Table]:
    runs, _ = find_runs([str(place)])
    return [to_table(comparison, PAPER, "full") for comparison in compare(runs, {"b": "B"}, {"ship": "Ship"})]


def test_metrics_on_maps_that_no_data_have_are_neither_columns_nor_notes(tmp_path: Path) -> None:
    write_run(tmp_path / "0", "a", 20.0)
    runs, _ = find_runs([str(tmp_path)])
    (comparison,) = compare(runs, {}, {})
    table = to_table(comparison, image_metrics(), "full")
    assert "depth RMSE" not in [column.title for column in table.columns]
    assert table.notes == ()


def cell(table: Table, label: str, group: str, title: str = "PSNR") -> tuple[float | None, float | None]:
    column = next(i for i, c in enumerate(table.columns) if (c.group, c.title) == (group, title))
    row = next(row for row in table.rows if row.label == label)
    return row.values[column], row.spread(column)


def test_seeds_become_a_mean_and_a_sample_deviation_and_titles_give_the_order(tmp_path: Path) -> None:
    for seed, psnr in enumerate((20.0, 21.0, 23.0)):
        write_run(tmp_path / f"deep/er/{seed}", "a", psnr, seed)
        write_run(tmp_path / f"b{seed}", "b", 30.0 + seed, seed)
        write_run(tmp_path / f"ship{seed}", "b", 25.0, seed, root="scenes/ship")
    (table,) = tables(tmp_path)
    assert [row.label for row in table.rows] == ["B", "a"]
    assert [group for group, _ in table.groups()] == ["Ship", "torus"]
    mean, spread = cell(table, "a", "torus")
    assert mean == pytest.approx(64 / 3)
    assert spread == pytest.approx(statistics.stdev([20, 21, 23]))
    assert cell(table, "a", "Ship") == (None, None)
    assert "over 3 seeds" in table.title
    assert "2 test views; 16 x 16 pixels" in table.title


def test_runs_of_different_budgets_never_share_a_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_run(tmp_path / "0", "a", 20.0)
    write_run(tmp_path / "1", "a", 21.0, max_time="00:00:08:00")
    write_run(tmp_path / "2", "a", 22.0, max_time=None, max_steps=100)
    torch_threads = torch.get_num_threads()
    monkeypatch.setattr(torch, "get_num_threads", lambda: torch_threads + 7)
    write_run(tmp_path / "3", "a", 23.0)  # as long, on another device
    write_run(tmp_path / "4", "b", 24.0, max_time=None, max_steps=100)  # as many steps cost the same there
    write_run(tmp_path / "5", "a", 25.0, max_time="00:00:09:00", max_steps=10)
    found = tables(tmp_path)
    assert [[row.values[0] for row in table.rows] for table in found] == [[24.0, 22.0], [20.0], [23.0], [21.0], [25.0]]
    assert found[0].title.startswith("Budget: at most 100 steps of 512 rays;")
    assert found[3].title.startswith("Budget: at most 8 min on ")
    assert re.match(r"Budget: at most 9 min on .* and at most 10 steps of 512 rays;", found[4].title)
    assert len({re.split(";", table.title)[0] for table in found}) == 5


def test_different_scorings_have_separate_columns(tmp_path: Path) -> None:
    write_run(tmp_path / "0", "a", 20.0)
    write_run(tmp_path / "1", "b", 21.0, size=8)
    write_run(tmp_path / "2", "b", 22.0, root="elsewhere/torus")
    (table,) = tables(tmp_path)
    assert [group for group, _ in table.groups()] == [
        f"torus, 16 x 16 pixels, {Path('elsewhere/torus').resolve()}",
        f"torus, 8 x 8 pixels, {Path('scenes/torus').resolve()}",
        f"torus, 16 x 16 pixels, {Path('scenes/torus').resolve()}",
    ]
    assert [row.values[::3] for row in table.rows] == [(22.0, 21.0, None), (None, None, 20.0)]
    assert "pixels" not in table.title


def test_runs_of_one_name_that_differ_in_a_field_are_different_methods(tmp_path: Path) -> None:
    write_run(tmp_path / "0", "a", 20.0)
    write_run(tmp_path / "1", "a", 22.0, field={**FIELD, "width": 32}, seed=1)
    write_run(tmp_path / "2", "a", 24.0, field={"_target_": "nerfro.fields.hash_grid.HashGridField", "levels": 4})
    write_run(tmp_path / "3", "a", 25.0, root="scenes/ship")  # another mesh, and the same method
    (table,) = tables(tmp_path)
    labels = {row.label: row.values for row in table.rows}
    assert labels.keys() == {
        "a (field=HashGridField)",
        "a (field=NerfField, field.width=32)",
        "a (field=NerfField, field.width=64)",
    }
    assert labels["a (field=NerfField, field.width=64)"][::3] == (25.0, 20.0)


def test_newest_of_repeated_runs_counts_and_the_others_are_named(tmp_path: Path) -> None:
    for name, psnr, age in (("old", 20.0, 100), ("new", 25.0, 0), ("older", 22.0, 200)):
        folder = write_run(tmp_path / name, "a", psnr)
        stamp = os.stat(folder).st_mtime - age
        os.utime(folder / "metrics.json", (stamp, stamp))
    (table,) = tables(tmp_path)
    assert cell(table, "a", "torus") == (25.0, None)
    omitted = [note for note in table.notes if "is omitted" in note]
    assert len(omitted) == 2
    assert all(f"{tmp_path / 'new'} is a newer run" in note for note in omitted)


def test_missing_scores_are_missing_in_the_mean_too_and_have_their_reason(tmp_path: Path) -> None:
    write_run(tmp_path / "0", "a", 20.0, seed=0)
    write_run(tmp_path / "1", "a", 20.0, seed=1, lpips=None)
    (table,) = tables(tmp_path)
    assert [column.title for column in table.columns] == ["PSNR", "SSIM"]
    assert cell(table, "a", "torus") == (20.0, 0.0)
    assert "LPIPS n/a: no network" in table.notes


def test_scores_of_a_region_come_from_the_region(tmp_path: Path) -> None:
    write_run(tmp_path / "0", "a", 20.0)
    file = tmp_path / "0" / "metrics.json"
    content = json.loads(file.read_text())
    for view in content["views"]:
        view["regions"] = {"crop": {"psnr": 11.0, "ssim": 0.1, "lpips": 0.9}}
    file.write_text(json.dumps(content))
    (comparison,) = compare(find_runs([str(tmp_path)])[0], {}, {})
    table = to_table(comparison, PAPER, "crop")
    assert table.rows[0].values == (11.0, pytest.approx(0.1), pytest.approx(0.9))
    assert "scores of the crop" in table.title
    assert to_table(comparison, PAPER, "mask").rows[0].values == (None, None, None)


def test_folders_and_globs_are_accepted_and_runs_without_scores_are_named(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write_run(tmp_path / name, name, 20.0)
    (tmp_path / "c" / "metrics.json").unlink()
    runs, unfinished = find_runs([str(tmp_path / "[ab]"), str(tmp_path / "a"), str(tmp_path / "c")])
    assert [run.folder.name for run in runs] == ["a", "b"]
    assert len(unfinished) == 1
    assert str(tmp_path / "c") in unfinished[0]
    refused(r"has not been evaluated$", find_runs, [str(tmp_path / "c")])
    (tmp_path / "c" / LAST_CHECKPOINT).parent.mkdir()
    (tmp_path / "c" / LAST_CHECKPOINT).touch()
    refused(rf"; run python -m nerfro.evaluate checkpoint={tmp_path / 'c'}$", find_runs, [str(tmp_path / "c")])
    (tmp_path / "d").mkdir()
    (tmp_path / "d" / "cell.json").write_text(json.dumps({"state": "failed", "reason": "no space left"}))
    assert find_runs([str(tmp_path)])[1][1] == f"{tmp_path / 'd'} is omitted: it failed: no space left"
    refused("nowhere does not exist", find_runs, [str(tmp_path / "nowhere")])


def test_existing_folders_with_wildcards_in_their_names_are_not_patterns(tmp_path: Path) -> None:
    for name in ("a [12]", "a 1", "b*", "b1"):
        write_run(tmp_path / name, "a", 20.0)
    for name in ("a [12]", "b*"):
        assert [run.folder.name for run in find_runs([str(tmp_path / name)])[0]] == [name]


def test_run_without_its_first_image_is_omitted(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_run(tmp_path / name, name, 20.0)
    image = tmp_path / "b" / "images" / "test_000.png"
    image.unlink()
    runs, unfinished = find_runs([str(tmp_path)])
    assert [run.name for run in runs] == ["a"]
    assert unfinished == [f"{tmp_path / 'b'} is omitted: its image {image} does not exist; restore it"]
    refused(r"b is omitted: its image .*test_000\.png does not exist", find_runs, [str(tmp_path / "b")])


def test_run_without_scores_has_those_of_its_later_evaluation(tmp_path: Path) -> None:
    run = write_run(tmp_path / "a", "a", 20.0)
    for name in ("metrics.json", "images"):
        (run / "evaluate_test").mkdir(exist_ok=True)
        (run / name).rename(run / "evaluate_test" / name)
    (table,) = tables(run)
    assert cell(table, "a", "torus") == (20.0, None)


@pytest.fixture
def summarize(run_here: Runner) -> Runner:
    """Run `python -m nerfro.summary` in this process."""
    return functools.partial(run_here, "summary")


def test_command_prints_writes_all_forms_and_refuses_to_overwrite(tmp_path: Path, summarize: Runner) -> None:
    write_run(tmp_path / "runs" / "a", "refractive", 25.0)
    write_run(tmp_path / "runs" / "b", "mine", 22.0, max_time=None, max_steps=100)
    runs, out = f"runs={tmp_path / 'runs'}", tmp_path / "out"
    printed = summarize(runs, "methods.refractive=Ours", "+methods.mine=My own").out
    assert "Ours" in printed
    assert "My own" in printed
    assert not out.exists()
    summarize(runs, f"out={out}")
    assert {path.suffix for path in out.glob("[!.]*")} == {".csv", ".md", ".tex"}
    assert len(list(out.glob("[!.]*"))) == 6
    assert "22.00" in (out / "100_steps_of_512_rays.md").read_text()
    assert "overwrite=true" in summarize(runs, f"out={out}", code=1).error
    summarize(runs, f"out={out}", "overwrite=true")


def test_tables_of_runs_without_a_limit_lie_in_the_output_folder(tmp_path: Path, summarize: Runner) -> None:
    write_run(tmp_path / "run", "mine", 21.0, max_time=None)
    summarize(f"runs=[{tmp_path / 'run'}]", f"out={tmp_path / 'out'}")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "run"]
    assert (tmp_path / "out" / "unlimited.csv").read_text()


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("metrics=[]", "metrics: the list is empty; known: depth"),
        ("metrics=[psnr,foo]", "'foo' is not a metric; known: depth"),
        ("region=x", "choose 'full', 'mask', 'crop'"),
        ("pictures=[a.png]", "are shown in the report; add report=true"),
    ],
)
def test_mistakes_give_a_one_line_error(tmp_path: Path, summarize: Runner, override: str, said: str) -> None:
    write_run(tmp_path / "a", "refractive", 25.0)
    assert said in summarize(f"runs=[{tmp_path}]", override, code=1).error
