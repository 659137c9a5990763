"""The setpoint stages as a user runs them: on rendered frames, and on a folder of a user's; what is killed
goes on, and broken input leaves all as it was."""

import contextlib
import importlib
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from pipeline.setpoint.agents.files import restore_published, store_published
from pipeline.setpoint.frames import files as camera_files
from pipeline.setpoint.frames import nozzle_scene
from pipeline.setpoint.frames.files import restore_frames
from pipeline.setpoint.frames.rendered import flow_edges, standing_out
from pipeline.setpoint.settings import TrainClassifier
from pipeline.setpoint.simulation.recorded import WindowTable, window_rows, window_tables
from pipeline.setpoint.tables import (
    CLASSIFIED,
    CLASSIFIER_CURVE,
    DECISIONS,
    FRAME_PARTS,
    PATHS,
    RELIABILITY,
    SCOREBOARD,
    WINDOW_PARTS,
    WINDOWS,
)
from pipeline.setpoint.vision import files, own_pictures
from pipeline.setpoint.vision.calibrated_classifier import CalibratedClassifier, classify
from pipeline.setpoint.vision.calibration import ClassifierCalibration, Familiar
from pipeline.setpoint.vision.files import CLASSIFIER_SCHEMA, restore_classifier, store_classifier
from pipeline.setpoint.vision.proof import UNPROVEN, may_judge, verdict
from pipeline.setpoint.vision.vision_transformer import SMALL as SMALL_SIZE
from pipeline.setpoint.vision.vision_transformer import named_arrays, vision_transformer
from pipeline.setpoint.vision.window_flow import KNOTS_PERCENT, FlowCalibration
from pipeline.store import artifacts, params
from pipeline.store.artifacts import read_weights, write_weights
from stages import train_classifier
from tests.nozzle_folders import SHOTS, folder, rows, table
from tests.setpoint.synthetic import synthetic_table

ROOT = Path(__file__).parents[2]
TABLES = {
    "classified": CLASSIFIED, "reliability": RELIABILITY, "course": CLASSIFIER_CURVE, "windows": WINDOWS,
}  # fmt: skip
MODEL = ("weights.safetensors", "calibration.parquet")
RECIPE = {"epochs": 2, "cycle_epochs": 2, "warmup_epochs": 0, "batch": 16}
# a few frames of everything
SMALL = {
    "execution.jobs": 1,
    "render_frames.segments": {"learned": 3, "held_out": 1, "calibration": 2, "judged": 2},
    "render_frames.frames": {"learned": 1, "held_out": 2, "calibration": SHOTS, "judged": SHOTS},
    "render_frames.sweeps": {"learn": 1, "choose": 1, "judge": 1},
    "render_frames.sweep_windows": {"learn": 1.0, "choose": 1.0, "judge": 1.0},
    "render_frames.camera_segments": 240,
    "train_classifier.window": SHOTS,
    "train_classifier.false_alarms": 0.1,
    **{f"train_classifier.small.{key}": value for key, value in RECIPE.items()},
    "evaluate_setpoint.runs": 1,
    "evaluate_setpoint.pixels.starts": 1,
    "evaluate_setpoint.pixels.decisions": 20,
    "evaluate_setpoint.pixels.least_frames": 2,
}  # fmt: skip


def declare(changes: dict, source: Path = Path("params.yaml")) -> None:
    sections = params.read(source)
    for dotted, value in changes.items():
        *parents, key = dotted.split(".")
        place = sections
        for parent in parents:
            place = place[parent]
        place[key] = value
    Path("params.yaml").write_text(yaml.safe_dump(sections, sort_keys=False))


def stage(name: str) -> None:
    importlib.import_module(f"stages.{name}").main()


def begun(place: Path, **changes) -> Path:
    """A project with small parameters, in which one works from now on."""
    place.mkdir(parents=True, exist_ok=True)
    with contextlib.chdir(place):
        declare(
            SMALL | {f"train_classifier.{key}": value for key, value in changes.items()}, ROOT / "params.yaml"
        )
    return place


@pytest.fixture(scope="module")
def simulated(tmp_path_factory) -> Path:
    """A project in which the classifier was trained on rendered frames."""
    place = begun(tmp_path_factory.mktemp("simulated"))
    with contextlib.chdir(place):
        stage("render_frames")
        stage("train_classifier")
    return place


@pytest.fixture
def project(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(begun(tmp_path / "project"))
    return tmp_path / "project"


@pytest.fixture
def stored(project) -> Path:
    """A project with a classifier that has learned nothing, and made-up windows; to be spoiled."""
    knots = np.log(np.array(KNOTS_PERCENT) / 100)
    flow = FlowCalibration(knots, np.ones(len(knots)), 0.5)
    known = ClassifierCalibration(1.0, Familiar(np.zeros((3, 4)), np.eye(4)), 9.0, flow, UNPROVEN)
    out = project / "datasets/train_classifier"
    store_classifier(
        out,
        params.load(TrainClassifier, "train_classifier").size,
        CalibratedClassifier(vision_transformer(SMALL_SIZE, np.random.default_rng(0)), known),
    )
    tables = {part: synthetic_table(np.random.default_rng(1), segments=1, windows=2) for part in WINDOW_PARTS}
    artifacts.write_table(out / "windows.parquet", WINDOWS, window_rows(tables))
    return project


def refusal(name: str, capsys) -> str:
    """The one sentence with which a stage ends; but for what it remembers nothing was written."""

    def there():
        return {
            path: artifacts.sha256(path)
            for path in sorted(Path().rglob("*"))
            if path.is_file() and "memo" not in path.parts
        }

    before = there()
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        stage(name)
    said = [
        line
        for line in capsys.readouterr().err.splitlines()
        if line.startswith(f"{name}: ") and "%|" not in line and "frames: " not in line
    ]
    assert ended.value.code == 1
    assert len(said) == 1
    assert "; " in said[0]
    assert there() == before
    return said[0]


# ---- what comes out


def check_classifier(source: str, *, trained: bool = True) -> dict:
    """The artifacts of train_classifier in this folder, all and no other; returns its metrics."""
    out = Path("datasets/train_classifier")
    for name, schema in TABLES.items():
        rows = len(next(iter(artifacts.read_table(out / f"{name}.parquet", schema).values())))
        assert rows or (name == "course" and not trained), name
    frames = artifacts.read_json(out / "frames/frames.json")
    expected = {f"{name}.parquet" for name in (*TABLES, "calibration")} | {
        "weights.safetensors",
        "figures.json",
        "frames/frames.json",
    }
    expected |= {f"frames/{row['file']}" for row in frames}
    # real frames stand by what became of them
    assert all(("group" in row) == (source == "recordings") for row in frames)
    expected |= {camera_files.CAMERA_FILE}
    courses = {f"{figure}.tsv" for figure in ("training_loss", "held_out_loss", "held_out_accuracy")}
    expected |= {f"live/plots/metrics/vision_transformer/{name}" for name in courses if trained}
    assert {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()} == expected
    figures = artifacts.read_figures("train_classifier")
    shares = ("image_accuracy", "window_accuracy", "ece_image", "ece_window")
    for name in (*shares, "svc_image_accuracy") if trained else shares:
        assert 0 <= figures[name] <= 1
    assert figures["source"] == source
    bins = [(row["flow_low"], row["flow_high"]) for row in figures["by_flow"]]
    assert bins == [(low, low + 5) for low in range(70, 150, 5)]
    assert figures["right_70_150"].keys() == {"percent", "low", "high"}
    for low, high in figures["intervals_percent"].values():
        assert 0 <= low <= high <= 100
    if trained:
        assert figures["epochs"] == {"vision transformer": 2}
    proof = restore_classifier(*(f"{out}/{name}" for name in MODEL)).calibration.proof
    assert figures["proof"] == proof._asdict() | {
        "may_judge": may_judge(proof), "verdict": verdict(proof)
    }  # fmt: skip
    return figures


def test_on_rendered_frames_every_artifact_is_written_with_its_schema(simulated, monkeypatch):
    monkeypatch.chdir(simulated)
    figures = check_classifier("simulated")
    assert figures["data"]["frames"] == 15 * (3 * 1 + 1 * 2 + 2 * SHOTS + 2 * SHOTS)
    assert figures["data"]["valid"] + sum(figures["data"]["rejected"].values()) == figures["data"]["frames"]
    course = artifacts.read_table("datasets/train_classifier/course.parquet", CLASSIFIER_CURVE)
    assert course["epoch"].tolist() == [1, 2]


def test_a_training_that_was_killed_goes_on_and_ends_at_the_very_same_weights(
    simulated, project, monkeypatch
):
    p, write, epochs = params.load(TrainClassifier, "train_classifier"), write_weights, []
    shutil.copytree(simulated / "datasets/render_frames", "datasets/render_frames")
    found = restore_frames(Path("datasets/render_frames"), FRAME_PARTS)
    found = {part: standing_out(frames, p.least_score) for part, frames in found.items()}

    def killing(path, name, arrays, about):
        write(path, name, arrays, about)
        epochs.append(int(about["epoch"]))
        if len(epochs) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(files, "write_weights", killing)
    with pytest.raises(KeyboardInterrupt):
        train_classifier.train(p, found)
    once = train_classifier.train(p, found)
    assert epochs == [1, 2], "each epoch was learned once"
    # a damaged checkpoint is begun anew
    for path in Path("datasets/memo/train_classifier").glob("*.safetensors"):
        path.write_bytes(path.read_bytes()[:1000])
    twice = train_classifier.train(p, found)
    assert epochs == [1, 2, 1, 2]
    whole, _ = read_weights(simulated / "datasets/train_classifier/weights.safetensors", CLASSIFIER_SCHEMA)
    for state in (once, twice):
        arrays = named_arrays(state.best)
        assert arrays.keys() == whole.keys()
        for name, values in whole.items():
            np.testing.assert_array_equal(arrays[name], values, err_msg=name)


# ---- rendered frames


def test_rendered_parts_share_no_segment_and_every_bin_has_a_window_in_every_part(simulated, monkeypatch):
    monkeypatch.chdir(simulated)
    found = restore_frames(Path("datasets/render_frames"), (*FRAME_PARTS, *WINDOW_PARTS))
    segments = [set(frames.segment.tolist()) for frames in found.values()]
    assert sum(map(len, segments)) == len(set.union(*segments)) == 15 * (3 + 1 + 2 + 2) + 3
    for part, frames in found.items():
        assert len(frames.valid) == len(frames.images) == len(frames.score), part
        np.testing.assert_array_equal(frames.label, nozzle_scene.label(frames.flow))
    table = artifacts.read_table("datasets/train_classifier/windows.parquet", WINDOWS)
    tables = window_tables(table, WINDOW_PARTS)
    bins = len(tables["judge"].flow_edges) - 1
    for part, recorded in tables.items():
        assert set(recorded.flow_bin.tolist()) == set(range(bins)), part
        assert set(recorded.segment.tolist()) <= set(found[part].segment.tolist())
        low, high = (recorded.flow_edges[recorded.flow_bin + end] for end in (0, 1))
        assert ((recorded.flow >= low) & (recorded.flow <= high)).all()


@pytest.mark.parametrize("backend", ["loky", "dask"])
def test_rendering_again_gives_the_same_bytes_whatever_the_workers(simulated, project, cluster, backend):
    scheduler = cluster.address if backend == "dask" else ""
    declare({"execution.jobs": 2, "execution.backend": backend, "execution.scheduler": scheduler})
    stage("render_frames")
    assert artifacts.sha256("datasets/render_frames") == artifacts.sha256(
        simulated / "datasets/render_frames"
    )


def test_how_far_a_line_must_stand_out_is_decided_after_rendering(simulated):
    frames = restore_frames(simulated / "datasets/render_frames", ["judged"])["judged"]
    assert (frames.score[frames.valid] < 10).any()
    strict = standing_out(frames, 10.0)
    np.testing.assert_array_equal(strict.valid, frames.valid & (frames.score >= 10))
    assert not strict.images[~strict.valid].any()
    assert all(reason.startswith("no fresh line: ") for reason in strict.reasons[~strict.valid])
    assert not any(strict.reasons[strict.valid])


def test_frames_that_are_damaged_or_were_never_rendered_are_refused_by_name(simulated, project, capsys):
    said = refusal("train_classifier", capsys)
    assert "datasets/render_frames/learned.safetensors is missing" in said
    assert "make it again with ./run dvc repro render_frames" in said
    shutil.copytree(simulated / "datasets/render_frames", "datasets/render_frames")
    path = Path("datasets/render_frames/choose.safetensors")
    path.write_bytes(path.read_bytes()[:1000])
    assert f"{path} holds no whole weights" in refusal("train_classifier", capsys)


def test_recordings_need_no_rendering(project):
    declare({"train_classifier.source": "recordings"})
    stage("render_frames")
    assert [path.name for path in Path("datasets/render_frames").iterdir()] == ["frames.json"]


# ---- there and back


def test_the_calibrated_classifier_survives_being_stored(simulated, project):
    names = [f"{simulated}/datasets/train_classifier/{name}" for name in MODEL]
    found = restore_classifier(*names)
    store_classifier(Path("again"), params.load(TrainClassifier, "train_classifier").size, found)
    for name in names:
        assert Path("again", Path(name).name).read_bytes() == Path(name).read_bytes()
    images = np.random.default_rng(1).integers(0, 256, (5, 16, 48), np.uint8)
    once, twice = (
        classify(one, images, np.full(5, 210.0))
        for one in (found, restore_classifier("again/weights.safetensors", "again/calibration.parquet"))
    )
    for a, b in zip(once, twice, strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(once[0].sum(axis=1), 1, atol=1e-12)  # double precision


def test_window_tables_survive_being_written(simulated, tmp_path):
    made = {
        part: synthetic_table(np.random.default_rng(k), segments=3, windows=2)
        for k, part in enumerate(WINDOW_PARTS)
    }
    artifacts.write_table(tmp_path / "windows.parquet", WINDOWS, window_rows(made))
    found = window_tables(artifacts.read_table(tmp_path / "windows.parquet", WINDOWS), WINDOW_PARTS)
    for part, one in made.items():
        for name, a, b in zip(WindowTable._fields, one, found[part], strict=True):
            np.testing.assert_array_equal(a, b, err_msg=name)
    columns = artifacts.read_table(simulated / "datasets/train_classifier/windows.parquet", WINDOWS)
    again = window_rows(window_tables(columns, WINDOW_PARTS))
    for name, values in columns.items():
        np.testing.assert_array_equal(again[name], values, err_msg=name)


def test_bins_of_the_flow_by_hand():
    # no bin without a window in any set: [20, 30) .. [60, 70) are one, 100 and 105
    # are two, and what lies above the last stays with it
    np.testing.assert_array_equal(
        flow_edges([np.array([60.0, 100.0, 106.0]), np.array([25.0, 101.0, 140.0])]),
        [20.0, 70.0, 102.5, 310.0],
    )
    # one set has nothing above the other's: one bin
    np.testing.assert_array_equal(flow_edges([np.array([15.0]), np.array([320.0])]), [15.0, 320.0])


def test_the_networks_of_every_phase_survive_being_stored(tmp_path):
    import jax

    from pipeline.setpoint.agents.agent import QNetwork

    networks = tuple(QNetwork(key) for key in jax.random.split(jax.random.key(3), 4))
    store_published(tmp_path / "a.safetensors", networks)
    again = restore_published(tmp_path / "a.safetensors")
    for stored, restored in zip(networks, again.networks, strict=True):
        leaves = [jax.tree.leaves(one) for one in (stored, restored)]
        assert len(leaves[0]) == len(leaves[1]) > 0
        for a, b in zip(*leaves, strict=True):
            np.testing.assert_array_equal(a, b)


# ---- weights and tables that are not what they should be


def test_damaged_or_foreign_weights_are_refused_by_name(stored, capsys):
    path = Path("datasets/train_classifier/weights.safetensors")
    whole = path.read_bytes()
    for spoilt in (b"", whole[:100], whole[: len(whole) // 2]):
        path.write_bytes(spoilt)
        said = refusal("evaluate_setpoint", capsys)
        assert f"{path} holds no whole weights" in said
        assert "make it again with ./run dvc repro train_classifier" in said
    path.write_bytes(whole)
    arrays, _ = read_weights(path, CLASSIFIER_SCHEMA)
    write_weights(path, CLASSIFIER_SCHEMA, arrays, {"size": "paper"})
    assert f"{path}: weights of another architecture: " in refusal("evaluate_setpoint", capsys)
    write_weights(path, CLASSIFIER_SCHEMA, arrays, {"size": "huge"})
    assert f"{path} should say its size, small or paper, but says huge" in refusal(
        "evaluate_setpoint", capsys
    )
    write_weights(path, "agents 1", arrays, {"size": "small"})
    assert f"{path} should hold weights of classifier 2 but has schema agents 1" in refusal(
        "evaluate_setpoint", capsys
    )
    path.unlink()
    assert f"{path} is missing" in refusal("evaluate_setpoint", capsys)


def test_damaged_windows_are_refused_by_name(stored, capsys):
    path = Path("datasets/train_classifier/windows.parquet")
    path.write_bytes(path.read_bytes()[:500])
    assert f"{path} is not a whole Parquet file" in refusal("evaluate_setpoint", capsys)
    path.unlink()
    assert f"{path} is missing; make it again with ./run dvc repro train_classifier" in refusal(
        "evaluate_setpoint", capsys
    )


# ---- a user's folder

PRINTS = 12
SHARES = {"learned": 4, "held_out": 2, "calibration": 3, "judged": 3}


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> Path:
    return folder(tmp_path_factory.mktemp("frames") / "setpoint", PRINTS)


@pytest.fixture
def users(frames, tmp_path, monkeypatch) -> Path:
    """A project with a user's folder, whose images are elsewhere; returns the
    folder. What is cut in one test is known in the next."""
    monkeypatch.chdir(begun(tmp_path / "project", source="recordings", prints=SHARES))
    place, memo = Path("datasets/raw/setpoint"), frames.parent / "memo"
    place.mkdir(parents=True)
    memo.mkdir(exist_ok=True)
    Path("datasets/memo").symlink_to(memo)
    shutil.copy(frames / "log.csv", place)
    for k in range(PRINTS):
        (place / f"print{k}").symlink_to(frames / f"print{k}")
    ship()
    return place


def ship() -> None:
    """The shipped network in a project."""
    Path(train_classifier.SHIPPED).parent.mkdir(parents=True)
    shutil.copy(ROOT / train_classifier.SHIPPED, train_classifier.SHIPPED)


@pytest.fixture
def many(monkeypatch):
    """Every folder has segments enough to train a network."""
    monkeypatch.setattr(own_pictures, "TRAINED_FROM", 0)


@pytest.mark.slow
def test_on_many_pictures_a_network_is_trained_and_every_artifact_is_written(users, many):
    declare({"train_classifier.prints": dict.fromkeys(SHARES, 2)})
    stage("train_classifier")
    figures = check_classifier("recordings")
    assert figures["data"]["frames"] == 3 * SHOTS * PRINTS
    assert figures["data"]["prints"] == PRINTS
    assert figures["data"]["valid"] + sum(figures["data"]["rejected"].values()) == figures["data"]["frames"]
    first = artifacts.sha256("datasets/train_classifier"), artifacts.sha256("reports")
    for path in Path("datasets/memo").rglob("*.safetensors"):
        path.unlink()
    stage("train_classifier")
    assert (artifacts.sha256("datasets/train_classifier"), artifacts.sha256("reports")) == first


def test_few_pictures_move_the_heads_of_the_shipped_network_and_prove_or_hold(users):
    stage("train_classifier")
    figures = check_classifier("recordings", trained=False)
    mine, shipped = (
        read_weights(path, CLASSIFIER_SCHEMA)[0]
        for path in ("datasets/train_classifier/weights.safetensors", train_classifier.SHIPPED)
    )
    moved = {name for name in shipped if not np.array_equal(mine[name], shipped[name])}
    assert moved == {"head.classes.W", "head.classes.b", "flow_head.flow.W", "flow_head.flow.b"}
    proof = figures["proof"]
    assert (proof["windows"], proof["prints"]) == (3 * PRINTS, PRINTS)
    # in some windows no frame was measured
    assert 0 < proof["known_from"] < 3 * PRINTS and not proof["may_judge"]
    assert f"but {proof['known_from']} windows do not tell it from other cameras" in proof["verdict"]
    first = artifacts.sha256("datasets/train_classifier")
    stage("train_classifier")
    assert artifacts.sha256("datasets/train_classifier") == first


def lines(count: int = PRINTS, **changes) -> list[dict[str, str]]:
    return [dict(row, **changes) for row in rows(PRINTS)[: 3 * SHOTS * count]]


@pytest.mark.parametrize(
    ("made", "said"),
    [
        (lambda: lines(1), "no honest split: expected valid frames of at least 2 prints"),
        (lambda: lines(print_id="a", timestamp=""),
        "no honest split: expected valid frames of at least 2 prints"),
        (lambda: lines(2), "setpoint: expected class 0, under (flow < 90 %), in at least 3 prints"),
        (lambda: lines(flow_rate="100"), "expected valid frames of every class, found none of class 0"),
        (lambda: [dict(row, flow_rate=str(float(row["flow_rate"]) / 100)) for row in lines()],
        "or write flow_rate in percent"),
        (lambda: lines(flow_rate_class="3"), "log.csv: line 2: expected flow_rate_class within 0 and 2"),
        (lambda: [dict(row, img_path=f"gone/{k}.png") for k, row in enumerate(lines())],
        "the image is missing, the first line 2, gone/0.png"),
        (lambda: lines(nozzle_tip_x="400"), "inside the frame of 350 x 350 px but found (400, "),
    ],
    ids=["one print", "one name for all prints", "two prints", "one class",
    "shares for percent", "a label outside", "missing images", "a tip outside"],
)  # fmt: skip
def test_a_folder_that_cannot_be_learned_from_is_refused_before_training(users, capsys, made, said):
    table(users / "log.csv", made())
    assert said in refusal("train_classifier", capsys)
    assert not list(Path("datasets/memo").rglob("*.safetensors"))


def test_frames_that_are_too_small_are_refused(users, capsys):
    for row in lines():
        small = cv2.imread(str(users / row["img_path"]), cv2.IMREAD_GRAYSCALE)[150:200, 150:200]
        cv2.imwrite(str(users / row["img_path"].replace("/", "-")), small)
    table(users / "log.csv", [dict(row, img_path=row["img_path"].replace("/", "-")) for row in lines()])
    assert "expected at least 64 x 64 px but found 50 x 50" in refusal("train_classifier", capsys)


@pytest.mark.parametrize(
    ("made", "window", "said"),
    [
        (lambda: lines(2), SHOTS, "2 segments do not let each of 7 parts hold every class"),
        (lambda: lines(8), SHOTS, "expected at least 3 stretches of constant settings of class 0"),
        (lines, 20, "expected 20 frames in a row in the frames for judged, found none"),
    ],
    ids=["two prints", "few prints", "long windows"],
)
def test_many_pictures_that_no_network_can_be_trained_on_are_refused(users, many, capsys, made, window, said):
    declare({"train_classifier.window": window})
    table(users / "log.csv", made())
    assert said in refusal("train_classifier", capsys)
    assert not list(Path("datasets/memo").rglob("*.safetensors"))


def test_windows_longer_than_a_print_are_refused(users, capsys):
    declare({"train_classifier.window": 3 * SHOTS + 1})
    assert f"expected a segment with {3 * SHOTS + 1} frames in a row but found none" in refusal(
        "train_classifier", capsys
    )


# ---- the whole loop


def check_judgement() -> None:
    out = Path("datasets/evaluate_setpoint")
    board = artifacts.read_table(out / "scoreboard.parquet", SCOREBOARD)
    assert {"paper", "recorded", "pixels"} == set(board["simulator"])
    for name, schema in (("paths", PATHS), ("decisions", DECISIONS)):
        assert len(artifacts.read_table(out / f"{name}.parquet", schema)["step"])
    figures = artifacts.read_figures("evaluate_setpoint")
    assert figures["default"] == json.loads((out / "choice.json").read_text())["name"]
    assert figures["default"] in set(board["controller"])


@pytest.mark.slow
@pytest.mark.parametrize("source", ["simulated", "recordings"])
def test_the_whole_loop_runs_and_repeats_to_the_byte(source, frames, tmp_path, monkeypatch):
    changes = {"prints": SHARES} if source == "recordings" else {}
    monkeypatch.chdir(begun(tmp_path / "project", source=source, **changes))
    shutil.copytree(frames, "datasets/raw/setpoint")
    ship()
    found = []
    for _ in range(2):
        for name in ("render_frames", "train_classifier", "evaluate_setpoint"):
            stage(name)
        check_classifier(source, trained=source == "simulated")
        check_judgement()
        found.append(
            [artifacts.sha256(f"datasets/{name}") for name in ("train_classifier", "evaluate_setpoint")]
            + [artifacts.sha256("reports")]
        )
    assert found[0] == found[1]
