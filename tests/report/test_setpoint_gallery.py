"""The frames on the setpoint page: rendered ones as before, real ones by what became of them."""

from pathlib import Path

from pipeline.store import artifacts
from tests.report.made import main
from tests.report.test_pages import Page

PAGE, INDEX = Path("reports/setpoint.html"), Path("datasets/train_classifier/frames/frames.json")
SHARES = {"accepted": 0.7, "wrong": 0.125, "rejected": 0.15, "foreign": 0.025}


def page():
    main()
    return Page(PAGE).text


def real(kinds):
    """The made-up frames as a gallery of these kinds."""
    rows = artifacts.read_json(INDEX)
    for row, kind in zip(rows, kinds, strict=False):
        row |= {
            "group": kind,
            "place": kind,
            "share": SHARES[kind],
            "source": f"datasets/raw/setpoint/a_long_folder_of_prints/log.csv: line {row['score']}, <b>x.jpg",
            "reason": {"rejected": "several lines: two of them", "foreign": "foreign: far off"}.get(kind, ""),
            "label": 1,
            "named": None if kind == "rejected" else 2 if kind == "wrong" else 1,
            "p": None if kind == "rejected" else [0.1, 0.2, 0.7],
        }
    artifacts.write_json(INDEX, rows[: len(kinds)])


def test_rendered_frames_are_called_rendered(project):
    text = page()
    assert "These frames are rendered." in text
    assert "These frames are real" not in text and "named wrongly: the surest first" not in text


def test_real_frames_stand_by_what_became_of_them_with_share_and_reason(project):
    real(["accepted", "wrong", "rejected", "foreign"])
    text = page()
    assert "These frames are real, of prints that nothing was learned from" in text
    places = [
        text.index(words)
        for words in (
            "Accepted, and classified correctly: 70 % of the frames",
            "Accepted, and named wrongly: the surest first: 12 % of the frames",
            "Rejected by the front end: 15 % of the frames",
            "Foreign to the classifier: 2.5 % of the frames",
        )
    ]
    assert places == sorted(places)
    assert "rejected: several lines: two of them" in text
    assert "held: foreign: far off" in text
    assert "named over, 0.70" in text
    assert "<b>x.jpg" not in PAGE.read_text()  # text of data is escaped


def test_a_kind_without_a_frame_has_no_heading(project):
    real(["accepted", "rejected"])
    text = page()
    assert "Foreign to the classifier" not in text and "surest first" not in text
    assert "Rejected by the front end" in text
