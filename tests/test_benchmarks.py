"""The benchmarks run to their end at tiny sizes and print plausible rows. How fast anything is, is not tested."""

import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.edge_scene import NOISE_PX, make_scene, scatter_gaussians
from benchmarks.floor import FloorDiffers, FloorMissing, FloorStep, assert_same, compile_floor
from benchmarks.log_plot import log_ticks, tick_text
from benchmarks.markdown import significant, table
from benchmarks.photographs import cell, distances_to, row_of
from benchmarks.scaling import slopes
from benchmarks.view_step import PARTS, DumpedStep, part_of
from benchmarks.wireframe import STEP_COLUMNS, STEPS, cells, measure_part, scene_path
from benchmarks.wireframe import main as ablate
from taichi_edges.corridor.loading import load_scene
from taichi_edges.corridor.pipeline import Run
from taichi_edges.splatting.gaussians import Gaussians
from taichi_edges.views.cameras import project

ROOT = Path(__file__).parent.parent
SCENE = """
preset: paper
source: {reader: synthetic, part: block, views: 6, size: 64}
train: {epochs: 3, gaussians: 300, seeds: random}
filter: {min_opacity: 0.0, min_support: 0.0}
cluster: {max_gap: 0.3, min_points: 3, theta: 0.0}
fit: {line_tolerance: 0.1}
"""


def run(*arguments):
    """What `python <arguments>` prints, run from the root of the project."""
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def read_tables(text):
    """The Markdown tables in a text, each a list of {heading: cell}."""
    tables, headings = [], None
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line.startswith("|") else None
        if cells is None:
            headings = None
        elif headings is None:
            headings = cells
            tables.append([])
        elif not line.startswith("|-"):
            tables[-1].append(dict(zip(headings, cells, strict=True)))
    return tables


# The scripts --------------------------------------------------------------------------------------------------------


@pytest.mark.slow(reason="runs a benchmark")
def test_splat_prints_parts_and_ratios():
    text = run("benchmarks/splat.py", "--sizes", 300, 500, "--size", 200, "--repeats", 2, "--threads", 2)
    assert "Taichi" in text.splitlines()[0]
    steps, ratios = read_tables(text)
    assert [row["Gaussians"] for row in steps] == [row["Gaussians"] for row in ratios] == ["300", "500"]
    for row in steps:
        assert int(row["pixels"]) > 100
        assert all(float(row[part]) > 0 for part in ("select", "forward", "backward", "project'", "Adam", "step"))
        assert set(row) == {"Gaussians", "pixels", *PARTS, "launches", "step", "launches %"}  # every kernel has a part
    for row in ratios:
        assert float(row["twin / loss"]) > 1 and float(row["twin / gradient"]) > 1
        if "No C floor" in text:
            assert row["forward / C"] == "-"
        else:
            assert float(row["forward / C"]) > 0 and float(row["backward / C"]) > 0


@pytest.mark.slow(reason="runs a benchmark")
def test_pipeline_prints_stages_and_metrics(tmp_path):
    scene, lost = tmp_path / "tiny.yaml", tmp_path / "lost.yaml"
    scene.write_text(SCENE + "evaluation: {held_out: 1}\n")
    lost.write_text("source: {path: /nowhere/at/all}\n")
    text = run("benchmarks/pipeline.py", "--scene", scene, lost, "--threads", 2, "--seeds", 3, 4)
    seconds, memory, found, held_out = read_tables(text)
    assert [rows[0]["scene"] for rows in (seconds, memory, found, held_out)] == ["tiny"] * 4 and len(seconds) == 1
    stages = ("prepare", "train", "cluster", "fit", "refine", "evaluate", "export")
    assert float(seconds[0]["whole command"]) > sum(float(seconds[0][stage]) for stage in stages) > 0
    assert float(seconds[0]["peak MiB"]) >= max(float(memory[0][stage]) for stage in stages) > 50
    assert float(seconds[0]["of all threads"]) > 0 and "with each of the seeds 3, 4" in text
    assert found[0]["true edges"] == "12" and held_out[0]["views held out"] == "1"
    assert 0 <= float(found[0]["F5 %"]) <= 100
    assert 0 <= float(held_out[0]["recall of long edges %"]) <= 100
    assert "Skipped lost: source.path: /nowhere/at/all does not exist" in text


@pytest.mark.slow(reason="runs a benchmark")
def test_scaling_prints_points_and_draws(tmp_path):
    picture = tmp_path / "curves.png"
    base = ("--base", 300, 4, 96, "--large", 4, 96, 96, "--repeats", 1, "--threads", 2, "--out", picture)
    text = run("benchmarks/scaling.py", "--gaussians", 300, 600, "--views", 4, "--sizes", 96, *base)
    points, exponents, arrays, moments = read_tables(text)
    assert [row["Gaussians"] for row in points] == ["300", "600", "300", "300"]
    assert all(
        min(float(row["ms per step"]), float(row["ms of all threads"])) > 0 and float(row["peak MiB"]) > 50
        for row in points
    )
    assert exponents[0]["ms of all threads"].endswith("at the end)") and exponents[1]["ms of all threads"] == "-"
    maps, words = 4 * 96 * 96, 4 * 96 * 3 * 4
    wanted = {"maps of the reader": maps, "edge_words": words, "all of these": maps + words}
    assert {row["array"]: int(row["bytes"]) for row in arrays} == wanted
    assert "Maps and masks fit in 1 GiB" in text and len(moments) == 5
    assert cv2.imread(str(picture)).std() > 5


@pytest.mark.slow(reason="runs a benchmark")
def test_scale_prints_steps_and_exponents():
    text = run("benchmarks/scale.py", "--copies", 1, 2, "--windows", 1, "--threads", 2)
    rows, exponents = read_tables(text)
    assert [row["step"] for row in rows] == 2 * ["cluster", "fit", "refine"]
    assert int(rows[3]["points or edges"]) == 2 * int(rows[0]["points or edges"]) > 0
    assert all(float(row["seconds of all threads"]) > 0 for row in rows)
    assert [row["step"] for row in exponents] == ["cluster", "fit", "refine"]


@pytest.mark.slow(reason="starts processes")
def test_scripts_are_modules_too():
    assert "usage: python benchmarks/splat.py" in run("-m", "benchmarks.splat", "--help")


@pytest.mark.slow(reason="runs a benchmark")
def test_wireframe_adds_step_by_step_what_the_stages_do(tmp_path, capsys):
    scene = tmp_path / "tiny.yaml"
    scene.write_text("source: {reader: synthetic, part: block, views: 12, size: 120, detector: subpixel}\n")
    ablate([str(scene), "--out", str(tmp_path), "--threads", "2"])
    (rows,) = read_tables(capsys.readouterr().out)
    assert [row["step"] for row in rows] == [step.name for step in STEPS]
    assert set(rows[0]) == {"step", *STEP_COLUMNS}
    assert all(row["edges (true)"].endswith("(12)") and float(row["CPU s"]) >= 0 for row in rows)
    closed = {row["step"]: float(row["corners closed %"]) for row in rows}
    assert closed["+ merging"] == 0 and closed["+ joint adjustment: the default"] > 80  # loose ends close nothing
    default = measure_part(Run(load_scene(scene), tmp_path / "tiny", threads=2))
    assert list(rows[-1].values())[1:-1] == cells(default, STEP_COLUMNS)[:-1]


def test_wireframe_names_scenes_it_has_no_data_for(monkeypatch, capsys):
    monkeypatch.delenv("TAICHI_EDGES_DATA", raising=False)
    ablate(["cad_plate"])
    assert "Skipped cad_plate: source.path: cad/plate is relative" in capsys.readouterr().out
    assert scene_path("demo").is_file() and scene_path("here/mine.yaml") == Path("here/mine.yaml")


# Their rooms --------------------------------------------------------------------------------------------------------


def test_scene_has_gaussians_around_its_edges(generator):
    scene = make_scene(3, 120, 80)
    assert scene.edge_maps.shape == (3, 80, 120) and (scene.edge_maps > 0).sum(axis=(1, 2)).min() > 50
    gaussians = scatter_gaussians(scene, 2000, generator)
    away = cv2.distanceTransform((scene.edge_maps[0] == 0).astype(np.uint8), cv2.DIST_L2, 5)
    columns, rows = np.rint(project(gaussians.means, scene.intrinsics[0], scene.world_to_camera[0])[0]).astype(int).T
    inside = (columns >= 0) & (columns < 120) & (rows >= 0) & (rows < 80)
    assert inside.mean() > 0.95 and np.median(away[rows[inside], columns[inside]]) < 2 * NOISE_PX


def test_floor_that_differs_is_refused(generator):
    count, slots = 50, 400
    gradients, slopes_of_splats, pull = (
        generator.normal(size=(count, 6)),
        generator.normal(size=(count, 6)),
        np.ones(50),
    )
    direction = Gaussians(*(np.ones(shape) for shape in ((count, 3), (count, 3), (count, 4), (count,))))
    slope = (gradients * slopes_of_splats).sum(axis=1)
    taichi_gradients = Gaussians(np.zeros((count, 3)), np.zeros((count, 3)), np.zeros((count, 4)), slope)
    step = DumpedStep(generator.random(slots), 0.25, taichi_gradients, pull)
    same = FloorStep(step.transmittance, 0.25, gradients, pull)
    assert_same(step, same, slopes_of_splats, direction)
    for changed, message in (
        ({"transmittance": step.transmittance * 0.99}, "transmittance: .* differ"),
        ({"transmittance": step.transmittance * np.nan}, "transmittance: .* differ"),
        ({"loss": 0.2501}, "loss: 0.2501 instead of 0.25"),
        ({"gradients": gradients * [1, 1, 1, 1, 1, 1.1]}, "gradient: off by"),
        ({"pull": pull * 1.01}, "positional"),
    ):
        with pytest.raises(FloorDiffers, match=message):
            assert_same(step, replace(same, **changed), slopes_of_splats, direction)


def test_missing_compiler_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(FloorMissing, match="there is no gcc"):
        compile_floor()


@pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc")
def test_floor_compiles():
    assert compile_floor().forward


def test_kernels_belong_to_parts():
    assert part_of("draw_product_c88_0_kernel_0_range_for") == "forward"
    assert part_of("blend_serial_c90_0_kernel_0_serial") == "forward"
    assert part_of("gather_c92_0_kernel_1_range_for") == "backward"
    assert part_of("project_c87_0_reverse_grad_kernel_1_range_for") == "project'"
    assert part_of("project_c86_0_kernel_1_range_for") == "project"  # drawing projects by itself
    assert part_of("something_new_c3_0_kernel_0_serial") == "something_new"


def test_numbers_and_tables_read_well():
    numbers = (0.0, 12345.6, 123.4, 1.234, 0.01234, 9.996, float("nan"))
    assert [significant(x) for x in numbers] == ["0", "12346", "123", "1.23", "0.0123", "10.0", "-"]
    assert table(["a", "bb"], [[1, None]]) == "| a | bb |\n|---|----|\n| 1 | -  |"


def test_ticks_enclose_the_values():
    assert log_ticks([13.0, 13.1]) == [10, 20]
    assert log_ticks([3.0, 180.0]) == [2, 5, 10, 20, 50, 100, 200]
    assert log_ticks([2.0, 50_000.0]) == [1, 10, 100, 1000, 10_000, 100_000]
    assert [tick_text(x) for x in (0.5, 20, 1000, 1600, 500_000)] == ["0.5", "20", "1k", "1600", "500k"]


def test_slopes_are_exponents():
    xs = [1.0, 2.0, 4.0, 16.0]
    np.testing.assert_allclose(slopes(xs, [3 * x**1.5 for x in xs]), 1.5)
    np.testing.assert_allclose(slopes(xs, [1, 1, 1, 4])[1], 1.0)
    assert slopes([5.0], [1.0]) == (None, None)


def test_photographs_are_held_against_creases_that_run_the_same_way():
    x, y = np.array([[1.0, 0.0, 0.0]]), np.array([[0.0, 1.0, 0.0]])
    places = np.zeros((1, 3))
    assert distances_to(places, x, places + 0.2 * y, x, 0.3) == pytest.approx([0.2])
    assert (
        distances_to(places, x, places + 0.2 * y, y, 0.3)
        == distances_to(places, x, places + 0.4 * y, x, 0.3)
        == [np.inf]
    )
    along = np.linspace(0, 9, 10)[:, None] * x
    assert abs(row_of(along + 0.3 * np.sin(3 * along[:, :1]) * y)[0]) > 0.99
    angles = np.linspace(0, 6, 20)
    assert row_of(np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])) is None
    assert (cell([50.0, 52.0]), cell([1.25]), cell([None, 3.0])) == ("51.0 (2.0)", "1.25", None)
