"""What a machine wrote is read as it was, or refused in a sentence that says what to do. Never is it read as
something else."""

import numpy as np
import pytest

from pipeline.recordings.recordings import Source, read
from tests.recordings.variants import VARIANTS, Variant

# what each refusal says is to be done
REFUSED = {
    "gzip": "unpack it with gunzip",
    "bzip2": "unpack it with bunzip2",
    "zstd": "unpack it with zstd -d",
    "hexadecimal": "column duty should be a number but is '0x0'; mend that line",
    "names_twice": "give each a name of its own",
    "no_header": "name it, or write time: every 1.0 s",
    "thousands_not_throughout": "write the numbers without marks between thousands",
    "only_thousandths": 'declare ingest.decimal: "," for 1.000, or "." for 1000',
    "day_or_month_first": "(day or month first: 2025-01-02 or 2025-02-01?); convert it",
    "pandas_index_of_row_numbers": "counts the rows 0, 1, 2, ..., which is no time; write time: every 1.0 s",
    "parquet_pandas_row_numbers": "counts the rows 0, 1, 2, ..., which is no time; write time: every 1.0 s",
    "parquet_lists": "write numbers, or map another column",
}


def outcome(path, variant: Variant) -> str:
    """ "right", "wrong: ..." or the refusal."""
    path.write_bytes(variant.content)
    sources = [Source("u", variant.duty, "percent"), Source("y", variant.degC, "degC")]
    try:
        raw = read(path, sources, time=variant.time, decimal=variant.decimal)
    except ValueError as refusal:
        return str(refusal)
    (time, duty), (time_y, degC) = raw.signals["u"], raw.signals["y"]
    if not (len(time) == len(time_y) == len(variant.truth.time_s)):
        return f"wrong: {len(time)} rows of {len(variant.truth.time_s)}"
    # ten digits of a spreadsheet's day are 9 us, and seconds since 1601 or in ns are doubles to 0.3 us
    if not np.allclose(time - time[0], variant.truth.time_s, rtol=0, atol=2e-5):
        return f"wrong: times {time[:4]}, {time[-2:]}"
    for signal, truth in ((duty, variant.truth.duty), (degC, variant.truth.degC)):
        if not np.array_equal(signal, truth, equal_nan=True):
            return f"wrong: values {signal[:4]} of {truth[:4]}"
    return "right"


@pytest.mark.parametrize("name", VARIANTS)
def test_a_variant_is_read_as_it_was_written_or_refused_with_what_to_do(tmp_path, name):
    variant = VARIANTS[name]
    outcome_of_it = outcome(tmp_path / f"recording{variant.suffix}", variant)
    if name in REFUSED:
        assert REFUSED[name] in outcome_of_it
    else:
        assert outcome_of_it == "right"


def test_of_at_least_73_variants_at_most_12_are_refused():
    assert len(VARIANTS) >= 73
    assert len(REFUSED) <= 12
    assert set(REFUSED) <= set(VARIANTS)
