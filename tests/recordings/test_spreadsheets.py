"""Workbooks written by hand from the standard (ECMA-376), without a library of spreadsheets."""

import io
import zipfile

import numpy as np
import pytest

from pipeline.recordings.formats import file_format
from pipeline.recordings.recordings import Source, inspect, read

CONTENT = (
    '<?xml version="1.0"?><Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="xml" ContentType="application/xml"/><Default Extension="rels" '
    'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Override PartName="/xl/workbook.xml" ContentType='
    '"application/vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml"/></Types>'
)
OFFICE = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
PACKAGE = "http://schemas.openxmlformats.org/package/2006/relationships"
MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
DATE = 's="1"'


def cell(column: int, row: int, value, style: str = "") -> str:
    place = f"{chr(65 + column)}{row}"
    if isinstance(value, str):
        return f'<c r="{place}" t="inlineStr"><is><t>{value}</t></is></c>'
    return f'<c r="{place}" {style}><v>{value!r}</v></c>'


def sheet(rows, dates: tuple[int, ...] = ()) -> str:
    body = "".join(
        f'<row r="{i}">'
        + "".join(
            cell(j, i, value, DATE if j in dates else "") for j, value in enumerate(row) if value is not None
        )
        + "</row>"
        for i, row in enumerate(rows, 1)
    )
    return f'<?xml version="1.0"?><worksheet xmlns="{MAIN}"><sheetData>{body}</sheetData></worksheet>'


def workbook(*sheets: str) -> bytes:
    stream = io.BytesIO()
    names = "".join(f'<sheet name="Sheet{i}" sheetId="{i}" r:id="r{i}"/>' for i in range(1, len(sheets) + 1))
    links = "".join(
        f'<Relationship Id="r{i}" Type="{OFFICE}/worksheet" Target="worksheets/sheet{i}.xml"/>'
        for i in range(1, len(sheets) + 1)
    )
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("[Content_Types].xml", CONTENT)
        archive.writestr(
            "_rels/.rels",
            f'<Relationships xmlns="{PACKAGE}"><Relationship Id="a" Type="{OFFICE}/officeDocument" '
            'Target="xl/workbook.xml"/></Relationships>',
        )
        archive.writestr(
            "xl/workbook.xml",
            f'<workbook xmlns="{MAIN}" xmlns:r="{OFFICE}"><sheets>{names}</sheets></workbook>',
        )
        archive.writestr(
            "xl/_rels/workbook.xml.rels",
            f'<Relationships xmlns="{PACKAGE}">{links}<Relationship Id="s" Type="{OFFICE}/styles" '
            'Target="styles.xml"/></Relationships>',
        )
        archive.writestr(
            "xl/styles.xml",
            f'<styleSheet xmlns="{MAIN}"><cellXfs count="2"><xf numFmtId="0"/><xf numFmtId="22"/></cellXfs>'
            "</styleSheet>",
        )
        for i, text in enumerate(sheets, 1):
            archive.writestr(f"xl/worksheets/sheet{i}.xml", text)
    return stream.getvalue()


def write(tmp_path, content: bytes):
    path = tmp_path / "rig.xlsx"
    path.write_bytes(content)
    return path


ROWS = [(k * 0.5, 20.25 + k, float(k % 3 * 50)) for k in range(40)]
SOURCES = [Source("y", "T1", "degC"), Source("u", "duty", "percent")]


def test_the_numbers_are_those_of_the_sheet_under_its_names_and_units(tmp_path):
    rows = [("Trend of line 3",), ("t", "T1", "duty"), ("s", "degC", "%"), *ROWS]
    path = write(tmp_path, workbook(sheet(rows)))
    assert file_format(path) == "xlsx"
    raw = read(path, SOURCES)
    np.testing.assert_array_equal(raw.signals["y"][0], [row[0] for row in ROWS])
    np.testing.assert_array_equal(raw.signals["y"][1], [row[1] for row in ROWS])
    np.testing.assert_array_equal(raw.signals["u"][1], [row[2] for row in ROWS])
    text = inspect(path)
    assert "{source: T1, unit: degC" in text and "{source: duty, unit: percent" in text


def test_cells_that_are_dates_are_the_clock(tmp_path):
    day = 45982.0  # 2025-11-21 in the days of spreadsheets
    rows = [("when", "T1", "duty"), *((day + row[0] / 86400, *row[1:]) for row in ROWS)]
    raw = read(write(tmp_path, workbook(sheet(rows, dates=(0,)))), SOURCES)
    # a sheet's days are doubles: 0.6 us there; and read to the millisecond
    np.testing.assert_allclose(raw.signals["y"][0], [row[0] for row in ROWS], atol=1.1e-3)
    assert any("counted from 2025-11-21T00:00:00" in note.message for note in raw.notes)


def test_empty_cells_are_missing_and_the_sheet_with_the_numbers_is_read(tmp_path):
    rows = [("t", "T1", "duty"), *ROWS]
    rows[5] = (rows[5][0], None, rows[5][2])
    raw = read(write(tmp_path, workbook(sheet([("notes",), (1.0,)]), sheet(rows))), SOURCES)
    assert np.flatnonzero(np.isnan(raw.signals["y"][1])).tolist() == [4]
    messages = " ".join(note.message for note in raw.notes)
    assert "sheet 'Sheet2', with the most numbers, was read" in messages
    assert "row 6 of sheet Sheet2" in messages


def test_text_amid_numbers_is_refused_with_its_row(tmp_path):
    rows = [("t", "T1", "duty"), *ROWS]
    rows[7] = (rows[7][0], "12,5 C", rows[7][2])
    with pytest.raises(
        ValueError, match="row 8 of sheet Sheet1, column T1 should be a number but is '12,5 C'"
    ):
        read(write(tmp_path, workbook(sheet(rows))), SOURCES)


@pytest.mark.parametrize("share", [0.3, 0.9, 0.99])
def test_a_truncated_workbook_is_refused_in_one_sentence(tmp_path, share):
    content = workbook(sheet([("t", "T1", "duty"), *ROWS]))
    with pytest.raises(ValueError, match="is not a whole workbook .* so copy the recording again"):
        read(write(tmp_path, content[: int(share * len(content))]), SOURCES)


def test_a_garbled_workbook_is_read_or_refused(tmp_path):
    content, rng = workbook(sheet([("t", "T1", "duty"), *ROWS])), np.random.default_rng(0)
    for _ in range(100):
        changed = bytearray(content)
        changed[rng.integers(4, len(changed))] ^= 1 << rng.integers(0, 8)
        path = write(tmp_path, bytes(changed))
        try:
            raw = read(path, SOURCES)
            np.testing.assert_array_equal(raw.signals["y"][1], [row[1] for row in ROWS])
        except ValueError as refused:
            assert str(refused).startswith(str(path))


def test_a_workbook_without_numbers_is_refused(tmp_path):
    with pytest.raises(ValueError, match="none of its 1 sheets holds rows of numbers"):
        read(write(tmp_path, workbook(sheet([("name", "owner"), ("rig", "bob")]))), SOURCES)


def test_a_workbook_that_would_unpack_to_gigabytes_is_refused_unread(tmp_path):
    far = '<c r="XFD1048576"><v>1</v></c>'
    text = sheet([("t", "T1"), (0.0, 1.0)]).replace("</sheetData>", f"<row>{far}</row></sheetData>")
    with pytest.raises(ValueError, match="reaches to row 1048576 and column 16384"):
        read(write(tmp_path, workbook(text)), SOURCES)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/workbook.xml", "")
        with archive.open("xl/sharedStrings.xml", "w", force_zip64=True) as member:
            for _ in range(600):
                member.write(bytes(1 << 20))
    with pytest.raises(ValueError, match="unpacks to 600 MB, more than the 512 MB"):
        read(write(tmp_path, stream.getvalue()), SOURCES)


def test_a_text_that_thousands_of_cells_share_is_refused_before_it_is_copied(tmp_path):
    cells = "".join(f'<row r="{i}"><c r="A{i}" t="s"><v>0</v></c></row>' for i in range(1, 3001))
    content = io.BytesIO(workbook(f'<worksheet xmlns="{MAIN}"><sheetData>{cells}</sheetData></worksheet>'))
    with zipfile.ZipFile(content, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(
            "xl/sharedStrings.xml", f'<sst xmlns="{MAIN}"><si><t>{"x" * (1 << 20)}</t></si></sst>'
        )
    with pytest.raises(ValueError, match="its cells may hold more than 256 MB of text"):
        read(write(tmp_path, content.getvalue()), SOURCES)


@pytest.mark.parametrize("far", ['r = "XFD1048570"', "r='xfd1048570'"])
def test_a_cell_far_out_is_refused_however_its_place_is_written(tmp_path, far):
    rows = sheet([["time", "T1"], [0, 20.5], [1, 21.5]])
    text = rows.replace("</sheetData>", f"<row><c t='n' {far}><v>1</v></c></row></sheetData>")
    path = tmp_path / "rig.xlsx"
    path.write_bytes(workbook(text))
    with pytest.raises(ValueError, match="a sheet reaches to row 1048570 and column 16384"):
        read(path, [Source("zone", "T1", "degC")])
