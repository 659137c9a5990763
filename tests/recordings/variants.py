"""One record as many programs write it. Each variant makes the file's bytes by itself, without a line of the
readers, and says which times and values are in it."""

import bz2
import datetime
import decimal
import gzip
import io
import zoneinfo
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import zstandard

COUNT, INTERVAL_S = 60, 0.5
SECONDS = INTERVAL_S * np.arange(COUNT)
DUTY = np.repeat([0.0, 35.5, 60.0, 12.25, 80.0, 100.0], COUNT // 6)
DEGC = np.round(195.0 + 3.0 * np.sin(np.arange(COUNT) / 7.0) + 0.013 * np.arange(COUNT), 2)
START = datetime.datetime(2025, 11, 21, 13, 0, 0)


class Truth(NamedTuple):
    """What is in the file: times from the first row on (n,), duty and temperature (n,), NaN for no value."""

    time_s: np.ndarray = SECONDS
    duty: np.ndarray = DUTY
    degC: np.ndarray = DEGC


class Variant(NamedTuple):
    """A file, the columns of duty and temperature, the clock that its owner declares, and what is in it."""

    content: bytes
    duty: str = "duty"
    degC: str = "temp"
    time: str = ""
    decimal: str = ""
    truth: Truth = Truth()
    suffix: str = ".csv"


VARIANTS: dict[str, Variant] = {}


def variant(make: Callable[[], Variant]) -> None:
    VARIANTS[make.__name__.removeprefix("_")] = make()


def at(k: int, interval_s: float = INTERVAL_S) -> datetime.datetime:
    return START + datetime.timedelta(seconds=k * interval_s)


def comma(number: float) -> str:
    return str(number).replace(".", ",")


def rows(row: Callable[[int], str], end: str = "\n") -> str:
    return "".join(row(k) + end for k in range(COUNT))


def plain(k: int, delimiter: str = ",") -> str:
    return delimiter.join([str(SECONDS[k]), str(DUTY[k]), str(DEGC[k])])


def parquet(table: pa.Table, **options) -> bytes:
    stream = io.BytesIO()
    pq.write_table(table, stream, **options)
    return stream.getvalue()


def frame(**options) -> pd.DataFrame:
    return pd.DataFrame({"duty": DUTY, "temp": DEGC}, **options)


def frame_bytes(table: pd.DataFrame) -> bytes:
    stream = io.BytesIO()
    table.to_parquet(stream)
    return stream.getvalue()


BODY = "time_s,duty,temp\n" + rows(plain)

# ---- bytes: encodings, line ends, what stands before and behind

for name, text in {
    "plain": BODY,
    "crlf": BODY.replace("\n", "\r\n"),
    "cr_only": BODY.replace("\n", "\r"),
    "no_last_newline": BODY.rstrip("\n"),
    "empty_rows": BODY.replace("\n", "\n\n"),
    "blank_rows_of_delimiters": BODY.replace("\n12.0,", "\n,,\n12.0,"),
    "comments": "# made by a logger\n# rig 7\n" + BODY.replace("\n7.0,", "\n# a remark\n7.0,"),
    "percent_comments": "% made by MATLAB\n" + BODY,
    "header_in_a_comment": "# " + BODY,
    "repeated_header": BODY.replace("\n9.0,", "\ntime_s,duty,temp\n9.0,"),
    "footer": BODY + "\nAverage,47.9,195.0\n-- end --\n",
    "trailing_delimiter": BODY.replace("\n", ",\n"),
    "blanks_around": BODY.replace(",", " , "),
    "quoted_numbers": '"' + BODY.strip().replace(",", '","').replace("\n", '"\n"') + '"\n',
    "leading_plus": "time_s,duty,temp\n" + rows(lambda k: f"{SECONDS[k]},+{DUTY[k]},+{DEGC[k]}"),
    "scientific": "time_s,duty,temp\n" + rows(lambda k: f"{SECONDS[k]:.6e},{DUTY[k]:.8E},{DEGC[k]:.10e}"),
    "fortran": "time_s,duty,temp\n"
    + rows(lambda k: f"{SECONDS[k]},{DUTY[k]:.8E},{DEGC[k]:.10E}".replace("E", "D")),
    "semicolon": BODY.replace(",", ";"),
    "tab": BODY.replace(",", "\t"),
    "pipe": BODY.replace(",", "|"),
    "fixed_width": "  time_s    duty    temp\n"
    + rows(lambda k: f"{SECONDS[k]:8.1f}{DUTY[k]:8.2f}{DEGC[k]:8.2f}"),
    "semicolon_comma": BODY.replace(",", ";").replace(".", ","),
    "tab_comma": BODY.replace(",", "\t").replace(".", ","),
    "quoted_comma": '"'
    + BODY.strip().replace(",", '";"').replace(".", ",").replace(";", ",").replace("\n", '"\n"')
    + '"\n',
    "sep_line": "sep=;\n" + BODY.replace(",", ";").replace(".", ","),
    "units_row": "time,duty,temp\ns,%,degC\n" + rows(plain),
    "units_row_in_brackets": "time,duty,temp\n[s],[%],[°C]\n" + rows(plain),
    "three_decimals": "time_s,duty,temp\n" + rows(lambda k: f"{SECONDS[k]:.3f},{DUTY[k]:.3f},{DEGC[k]:.3f}"),
    "milliseconds": BODY.replace("time_s", "time_ms").split("\n")[0]
    + "\n"
    + rows(lambda k: f"{500 * k},{DUTY[k]},{DEGC[k]}"),
    "milliseconds_in_brackets": "Time [ms],duty,temp\n" + rows(lambda k: f"{500 * k},{DUTY[k]},{DEGC[k]}"),
    "hexadecimal": "time_s,duty,temp\n" + rows(lambda k: f"{SECONDS[k]},0x{int(DUTY[k]):X},{DEGC[k]}"),
    "numbers_with_units": "time_s,duty,temp\n" + rows(lambda k: f"{SECONDS[k]},{DUTY[k]} %,{DEGC[k]}"),
    "names_twice": "time_s,duty,temp,temp\n" + rows(lambda k: f"{plain(k)},25.0"),
    "no_header": rows(plain),
    "broken_last_line": BODY + "30.0,10",
}.items():
    VARIANTS[name] = Variant(text.encode())

VARIANTS |= {
    "bom": Variant(b"\xef\xbb\xbf" + BODY.encode()),
    "utf16_le": Variant(b"\xff\xfe" + BODY.encode("utf-16-le")),
    "utf16_be": Variant(b"\xfe\xff" + BODY.encode("utf-16-be")),
    "utf16_le_without_mark": Variant(BODY.encode("utf-16-le")),
    "utf16_be_without_mark": Variant(BODY.encode("utf-16-be")),
    "nul_tail": Variant(BODY.encode() + bytes(700)),
    "gzip": Variant(gzip.compress(BODY.encode(), mtime=0)),
    "bzip2": Variant(bz2.compress(BODY.encode())),
    "zstd": Variant(zstandard.compress(BODY.encode())),
    "no_header_by_number": Variant(rows(plain).encode(), "column_2", "column_3", "column_1"),
    "german_names": Variant(
        BODY.replace("duty", "Heizung [%]").replace("temp", "Düse [°C]").encode(), "Heizung [%]", "Düse [°C]"
    ),
    "windows_1252": Variant(BODY.replace("temp", "Düse °C").encode("cp1252"), degC="Düse °C"),
    "japanese_names": Variant(BODY.replace("temp", "温度").encode(), degC="温度"),
    "embedded_newlines": Variant(
        ("note,time_s,duty,temp\n" + rows(lambda k: f'"first\nsecond {k}",{plain(k)}')).encode()
    ),
    "delimiters_in_quotes": Variant(
        ("note,time_s,duty,temp\n" + rows(lambda k: f'"a, b, and ""c""",{plain(k)}')).encode()
    ),
}

# ---- numbers


@variant
def missing_words() -> Variant:
    words = ["NaN", "", "NA", "n/a", "null", "None", "#N/A", "--", "nan", "NULL"]
    degC = DEGC.copy()
    degC[::6] = np.nan
    text = rows(lambda k: f"{SECONDS[k]},{DUTY[k]},{words[k // 6 % 10] if k % 6 == 0 else DEGC[k]}")
    return Variant(f"time_s,duty,temp\n{text}".encode(), truth=Truth(degC=degC))


@variant
def infinite() -> Variant:
    degC = np.where(np.arange(COUNT) % 20 == 7, np.nan, DEGC)
    text = rows(lambda k: f"{SECONDS[k]},{DUTY[k]},{'-inf' if k % 20 == 7 else DEGC[k]}")
    return Variant(f"time_s,duty,temp\n{text}".encode(), truth=Truth(degC=degC))


@variant
def switch() -> Variant:
    text = rows(lambda k: f"{SECONDS[k]},{'ON' if DUTY[k] > 50 else 'OFF'},{DEGC[k]}")
    return Variant(f"time_s,duty,temp\n{text}".encode(), truth=Truth(duty=(DUTY > 50).astype(float)))


@variant
def true_and_false() -> Variant:
    text = rows(lambda k: f"{SECONDS[k]},{DUTY[k] > 50},{DEGC[k]}")
    return Variant(f"time_s,duty,temp\n{text}".encode(), truth=Truth(duty=(DUTY > 50).astype(float)))


LARGE = np.round(600.0 + 37.5 * np.arange(COUNT), 1)


def english(number: float) -> str:
    return f"{number:,.1f}"


def french(number: float) -> str:
    return english(number).replace(",", "\u202f").replace(".", ",")


def german(number: float) -> str:
    return english(number).replace(",", "_").replace(".", ",").replace("_", ".")


for name, text in {
    "thousands_english": rows(lambda k: f'{SECONDS[k]},{DUTY[k]},"{english(LARGE[k])}"'),
    "thousands_german": rows(lambda k: f"{comma(SECONDS[k])};{comma(DUTY[k])};{german(LARGE[k])}"),
    "thousands_french": rows(lambda k: f"{comma(SECONDS[k])};{comma(DUTY[k])};{french(LARGE[k])}"),
    "thousands_swiss": rows(lambda k: f"{SECONDS[k]};{DUTY[k]};{english(LARGE[k]).replace(',', chr(39))}"),
    "thousands_not_throughout": rows(
        lambda k: f"{comma(SECONDS[k])};{comma(DUTY[k])};{comma(LARGE[k]) if k % 2 else german(LARGE[k])}"
    ),
}.items():
    header = "time_s,duty,temp\n" if name == "thousands_english" else "time_s;duty;temp\n"
    VARIANTS[name] = Variant((header + text).encode(), truth=Truth(degC=LARGE))

# 1,000 and nothing else: one in Berlin, a thousand in London
_whole = np.arange(COUNT) // 10 + 1.0
_doubtful = "time_s;duty;temp\n" + rows(lambda k: f"{k};{_whole[k]:.0f},000;{2 + k % 3},250")
VARIANTS |= {
    "only_thousandths": Variant(_doubtful.encode()),
    "only_thousandths_declared_comma": Variant(
        _doubtful.encode(),
        decimal=",",
        truth=Truth(np.arange(COUNT) * 1.0, _whole, 2.25 + np.arange(COUNT) % 3),
    ),
    "only_thousandths_declared_point": Variant(
        _doubtful.encode(),
        decimal=".",
        truth=Truth(np.arange(COUNT) * 1.0, 1000 * _whole, 2250 + 1000.0 * (np.arange(COUNT) % 3)),
    ),
}


# ---- clocks


def stamped(name: str, write: Callable[[int], str], header: str = "timestamp,duty,temp", **options) -> None:
    delimiter = ";" if ";" in header else ","
    mark = comma if delimiter == ";" else str
    text = rows(lambda k: delimiter.join([write(k), mark(DUTY[k]), mark(DEGC[k])]))
    VARIANTS[name] = Variant(f"{header}\n{text}".encode(), **options)


WHOLE = Truth(np.arange(COUNT) * 1.0)
UNIX = 1_763_730_000
EXCEL_DAYS = 45982 + 13 / 24


def _half_hours(
    zone: str, begin: datetime.datetime, write: Callable[[datetime.datetime], str]
) -> Callable[[int], str]:
    """Local times every ten minutes from `begin` in UTC."""
    region = zoneinfo.ZoneInfo(zone)
    return lambda k: write(
        (begin + datetime.timedelta(minutes=10 * k)).replace(tzinfo=datetime.UTC).astimezone(region)
    )


AUTUMN, SPRING = datetime.datetime(2025, 10, 25, 22), datetime.datetime(2025, 3, 29, 22)
TENS = Truth(600.0 * np.arange(COUNT))

stamped("iso", lambda k: at(k).isoformat(timespec="milliseconds"))
stamped("iso_blank", lambda k: at(k).isoformat(" "))
stamped("iso_z", lambda k: at(k).isoformat(timespec="microseconds") + "Z")
stamped("iso_offset", lambda k: at(k).isoformat() + "+01:00")
stamped("iso_basic", lambda k: at(k).strftime("%Y%m%dT%H%M%S.%f"))
stamped("compact", lambda k: at(k, 1).strftime("%Y%m%d%H%M%S"), truth=WHOLE)
stamped("zone_letters", lambda k: at(k).isoformat(" ") + " CET")
stamped("zone_region", lambda k: at(k).isoformat(" ") + " Europe/Berlin")
stamped(
    "summer_time_ends_by_region",
    _half_hours("Europe/Berlin", AUTUMN, lambda t: f"{t:%Y-%m-%d %H:%M:%S} Europe/Berlin"),
    truth=TENS,
)
stamped(
    "summer_time_ends_by_letters",
    _half_hours("Europe/Berlin", AUTUMN, lambda t: f"{t:%Y-%m-%d %H:%M:%S %Z}"),
    truth=TENS,
)
stamped(
    "summer_time_ends_by_offset", _half_hours("Europe/Berlin", AUTUMN, lambda t: t.isoformat()), truth=TENS
)
stamped(
    "summer_time_ends_unsaid",
    _half_hours("Europe/Berlin", AUTUMN, lambda t: f"{t:%Y-%m-%d %H:%M:%S}"),
    truth=TENS,
)
stamped(
    "summer_time_begins_by_region",
    _half_hours("Europe/Berlin", SPRING, lambda t: f"{t:%Y-%m-%d %H:%M:%S} Europe/Berlin"),
    truth=TENS,
)
stamped("epoch_s", lambda k: f"{UNIX + 0.5 * k:.1f}")
stamped("epoch_ms", lambda k: str(UNIX * 1000 + 500 * k))
stamped("epoch_us", lambda k: str(UNIX * 10**6 + 500_000 * k))
stamped("epoch_ns", lambda k: str(UNIX * 10**9 + 500_000_000 * k))
stamped("epoch_windows", lambda k: str((UNIX + 11_644_473_600) * 10**7 + 5_000_000 * k))
stamped("epoch_labview", lambda k: f"{UNIX + 2_082_844_800 + 0.5 * k:.3f}")
stamped("excel_1900", lambda k: repr(round(EXCEL_DAYS + k / 86400, 10)), "Date,duty,temp", truth=WHOLE)
stamped(
    "excel_1904",
    lambda k: repr(round(EXCEL_DAYS - 1462 + k / 86400, 10)),
    "Date 1904,duty,temp",
    time="Date 1904",
    truth=WHOLE,
)
stamped("excel_half_seconds", lambda k: repr(round(EXCEL_DAYS + k / 172800, 12)), "Date,duty,temp")
stamped("matlab_days", lambda k: f"{739942 + 13 / 24 + k / 86400:.10f}", truth=WHOLE)
stamped("excel_german", lambda k: at(k, 1).strftime("%d.%m.%Y %H:%M:%S"), "Zeit;duty;temp", truth=WHOLE)
stamped("excel_english", lambda k: at(k, 1).strftime("%m/%d/%Y %I:%M:%S %p"), "Time,duty,temp", truth=WHOLE)
stamped(
    "twelve_hours_over_noon",
    lambda k: (at(k, 600) - datetime.timedelta(hours=5)).strftime("%I:%M:%S %p"),
    "time,duty,temp",
    truth=TENS,
)
stamped(
    "time_of_day_over_midnight",
    lambda k: (at(k, 600) + datetime.timedelta(hours=8)).strftime("%H:%M:%S"),
    "time,duty,temp",
    truth=TENS,
)
stamped(
    "date_and_time_apart",
    lambda k: at(k, 1).strftime("%d.%m.%Y;%H:%M:%S"),
    "Datum;Uhrzeit;duty;temp",
    truth=WHOLE,
)
stamped("month_names", lambda k: at(k, 1).strftime("%d-%b-%Y %H:%M:%S"), truth=WHOLE)
stamped(
    "day_first_decided",
    lambda k: at(k, 86400).strftime("%d/%m/%Y %H:%M"),
    truth=Truth(86400.0 * np.arange(COUNT)),
)
stamped(
    "day_or_month_first",
    lambda k: (datetime.datetime(2025, 1 + k // 12, 1 + k % 12)).strftime("%d/%m/%Y %H:%M"),
)
stamped("minutes", lambda k: repr(k / 120), "Time [min],duty,temp")
stamped(
    "newest_first",
    lambda k: str(SECONDS[COUNT - 1 - k]),
    "time_s,duty,temp",
    truth=Truth(SECONDS, DUTY[::-1], DEGC[::-1]),
)
stamped("two_rows_a_second", lambda k: at(k).strftime("%Y-%m-%d %H:%M:%S"))
stamped("temperature_called_T", lambda k: at(k).isoformat(" ") + f",{300 + k}", "timestamp,T,duty,temp")


@variant
def late_row() -> Variant:
    order = [*range(20), 21, 20, *range(22, COUNT)]
    return Variant(("time_s,duty,temp\n" + "".join(plain(k) + "\n" for k in order)).encode())


@variant
def row_twice() -> Variant:
    order = [*range(30), 29, *range(30, COUNT)]
    return Variant(("time_s,duty,temp\n" + "".join(plain(k) + "\n" for k in order)).encode())


@variant
def stamp_twice() -> Variant:
    extra = f"{SECONDS[29]},{DUTY[29]},99.5\n"
    text = "".join(plain(k) + "\n" + (extra if k == 29 else "") for k in range(COUNT))
    return Variant(("time_s,duty,temp\n" + text).encode())


# ---- programs


@variant
def pandas_index_of_seconds() -> Variant:
    return Variant(frame(index=SECONDS).to_csv().encode())


@variant
def pandas_index_of_stamps() -> Variant:
    return Variant(frame(index=pd.DatetimeIndex([at(k) for k in range(COUNT)])).to_csv().encode())


@variant
def pandas_index_of_stamps_with_zone() -> Variant:
    index = pd.DatetimeIndex([at(k) for k in range(COUNT)]).tz_localize("Europe/Berlin")
    return Variant(frame(index=index).to_csv().encode())


@variant
def pandas_index_of_row_numbers() -> Variant:
    return Variant(frame().to_csv().encode())


@variant
def pandas_index_of_row_numbers_declared() -> Variant:
    return Variant(frame().to_csv().encode(), time="every 0.5 s")


@variant
def pandas_index_twice_saved() -> Variant:
    table = pd.DataFrame({"Unnamed: 0": range(COUNT), "time_s": SECONDS, "duty": DUTY, "temp": DEGC})
    return Variant(table.to_csv().encode())


@variant
def pandas_two_headers() -> Variant:
    columns = pd.MultiIndex.from_tuples([("hotend", "duty"), ("hotend", "temp")])
    table = pd.DataFrame(np.c_[DUTY, DEGC], columns=columns, index=pd.Index(SECONDS, name="time_s"))
    return Variant(table.to_csv().encode())


@variant
def grafana() -> Variant:
    text = rows(lambda k: f'"{at(k):%Y-%m-%d %H:%M:%S}.{500 * (k % 2):03d}","{DUTY[k]}","{DEGC[k]}"', "\r\n")
    return Variant(('"Time","duty","temp"\r\n' + text).encode())


@variant
def grafana_with_units() -> Variant:
    text = rows(lambda k: f"{at(k).isoformat(timespec='milliseconds')},{DUTY[k]}%,{DEGC[k]} °C")
    return Variant(("Time,duty,temp\n" + text).encode())


@variant
def octoprint() -> Variant:
    text = rows(lambda k: f"{at(k, 1):%Y-%m-%d %H:%M:%S},{DEGC[k]},{DUTY[k]},60.0,60.0")
    header = "Time,tool0.actual,tool0.target,bed.actual,bed.target\n"
    return Variant((header + text).encode(), "tool0.target", "tool0.actual", truth=WHOLE)


@variant
def home_assistant() -> Variant:
    text = rows(lambda k: f"sensor.nozzle,{DEGC[k]},{DUTY[k]},{at(k).isoformat(timespec='milliseconds')}Z")
    return Variant(("entity_id,temp,duty,last_changed\n" + text).encode(), time="last_changed")


@variant
def influx() -> Variant:
    head = "#group,false,false,true,false,false\n#datatype,string,long,dateTime:RFC3339,double,double\n"
    text = rows(lambda k: f",,0,{at(k).isoformat(timespec='milliseconds')}Z,{DUTY[k]},{DEGC[k]}", "\r\n")
    return Variant((head + "#default,_result,,,,\n,result,table,_time,duty,temp\r\n" + text).encode())


@variant
def simulink() -> Variant:
    text = rows(lambda k: f"{SECONDS[k]:.16g},{DUTY[k]:.16g},{DEGC[k]:.16g}")
    return Variant(("time,duty,temp\n" + "Type: double,Type: double,Type: double\n" + text).encode())


LABVIEW = (
    "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\nDecimal_Separator\t{mark}\n"
    "Multi_Headings\tNo\nX_Columns\tOne\nTime_Pref\tAbsolute\nOperator\trig\nDate\t2025/11/21\n"
    "Time\t13:00:00{mark}0000000\n***End_of_Header***\t\n\t\nChannels\t2\t\t\nSamples\t60\t60\t\n"
    "Date\t2025/11/21\t2025/11/21\t\nTime\t13:00:00{mark}0\t13:00:00{mark}0\t\nY_Unit_Label\t%\tdegC\t\n"
    "X_Dimension\tTime\tTime\t\nX0\t0{mark}0000000E+0\t0{mark}0000000E+0\t\nDelta_X\t0{mark}500000\t0{mark}500000\t\n"
    "***End_of_Header***\t\t\t\nX_Value\tduty\ttemp\tComment\n"
)


@variant
def labview_lvm() -> Variant:
    text = rows(lambda k: f"{SECONDS[k]:.6f}\t{DUTY[k]:.6f}\t{DEGC[k]:.6f}", "\r\n")
    return Variant((LABVIEW.format(mark=".").replace("\n", "\r\n") + text).encode(), suffix=".lvm")


@variant
def labview_lvm_german() -> Variant:
    text = rows(lambda k: f"{SECONDS[k]:.6f}\t{DUTY[k]:.6f}\t{DEGC[k]:.6f}", "\r\n").replace(".", ",")
    return Variant((LABVIEW.format(mark=",").replace("\n", "\r\n") + text).encode(), suffix=".lvm")


@variant
def labview_text() -> Variant:
    text = rows(
        lambda k: f"{at(k):%d.%m.%Y %H:%M:%S},{500 * (k % 2):03d}\t{comma(DUTY[k])}\t{comma(DEGC[k])}", "\r\n"
    )
    return Variant(("Messung vom 21.11.2025\r\nProjekt\tRig 7\r\n\r\nZeit\tduty\ttemp\r\n" + text).encode())


@variant
def excel_german_csv() -> Variant:
    text = rows(
        lambda k: f"{at(k):%d.%m.%Y %H:%M:%S},{5 * (k % 2)};{comma(DUTY[k])};{comma(DEGC[k])};;", "\r\n"
    )
    return Variant(("Zeitstempel;Heizung;Düse;;\r\n" + text).encode("cp1252"), "Heizung", "Düse")


@variant
def excel_errors() -> Variant:
    degC = np.where(np.arange(COUNT) % 15 == 4, np.nan, DEGC)
    text = rows(lambda k: f"{plain(k).rsplit(',', 1)[0]},{'#VALUE!' if k % 15 == 4 else DEGC[k]}", "\r\n")
    return Variant(("time_s,duty,temp\r\n" + text).encode(), truth=Truth(degC=degC))


# ---- Parquet


def table(name: str, columns: dict[str, object], **options) -> None:
    VARIANTS[f"parquet_{name}"] = Variant(
        parquet(pa.table(columns | {"duty": DUTY, "temp": DEGC} | columns)), suffix=".parquet", **options
    )


NS = np.datetime64(START, "ns") + (SECONDS * 1e9).astype("timedelta64[ns]")
NULLED = np.where(np.arange(COUNT) % 9 == 5, np.nan, np.round(DEGC))
table("plain", {"time_s": SECONDS})
table("stamps_ns", {"time": pa.array(NS)})
table("stamps_ms", {"time": pa.array(NS).cast(pa.timestamp("ms"))})
table("stamps_zone", {"time": pa.array(NS).cast(pa.timestamp("us", "Europe/Berlin"))})
table("stamps_of_another_name", {"when": pa.array(NS), "T": np.arange(COUNT) + 300.0})
table("text_stamps", {"time": [at(k).isoformat() for k in range(COUNT)]})
table(
    "large_text_stamps",
    {"time": pa.array([at(k).isoformat() + "Z" for k in range(COUNT)], pa.large_string())},
)
table("time_of_day", {"time": pa.array((SECONDS * 1e3).astype(np.int32) + 46_800_000, pa.time32("ms"))})
table("duration", {"time": pa.array((SECONDS * 1e9).astype(np.int64), pa.duration("ns"))})
table(
    "dates",
    {"date": pa.array(20_000 + np.arange(COUNT, dtype=np.int32)).cast(pa.date32())},
    truth=Truth(86400.0 * np.arange(COUNT)),
)
table("epoch_ms", {"timestamp": UNIX * 1000 + 500 * np.arange(COUNT)})
table("categories", {"time_s": SECONDS, "duty": pa.array(DUTY).dictionary_encode()})
table("decimals", {"time_s": SECONDS, "temp": pa.array([decimal.Decimal(str(y)) for y in DEGC])})
table("half_floats", {"time_s": SECONDS, "duty": pa.array(DUTY.astype(np.float16))})
table(
    "nullable_integers",
    {"time_s": SECONDS, "temp": pa.array([None if np.isnan(y) else int(y) for y in NULLED], pa.int16())},
    truth=Truth(degC=NULLED),
)
table(
    "booleans", {"time_s": SECONDS, "duty": pa.array(DUTY > 50)}, truth=Truth(duty=(DUTY > 50).astype(float))
)
table(
    "nested",
    {
        "time_s": SECONDS,
        "hotend": pa.array([{"temp": y, "pid": {"out": u}} for y, u in zip(DEGC, DUTY, strict=True)]),
    },
    duty="hotend.pid.out",
    degC="hotend.temp",
)
table("lists", {"time_s": SECONDS, "temp": pa.array([[y] for y in DEGC])})
table("numbers_as_text", {"time_s": SECONDS, "temp": [str(y) for y in DEGC]})


@variant
def parquet_pandas_index() -> Variant:
    return Variant(frame_bytes(frame(index=SECONDS)), suffix=".parquet")


@variant
def parquet_pandas_index_of_stamps() -> Variant:
    return Variant(frame_bytes(frame(index=pd.DatetimeIndex(NS))), suffix=".parquet")


@variant
def parquet_pandas_two_indices() -> Variant:
    index = pd.MultiIndex.from_arrays([["print 1"] * COUNT, SECONDS], names=["print", "time_s"])
    return Variant(frame_bytes(frame(index=index)), suffix=".parquet")


@variant
def parquet_pandas_row_numbers() -> Variant:
    return Variant(frame_bytes(frame(index=pd.Index(list(range(COUNT)), dtype="int64"))), suffix=".parquet")


@variant
def parquet_brotli_in_small_groups() -> Variant:
    content = parquet(
        pa.table({"time_s": SECONDS, "duty": DUTY, "temp": DEGC}), compression="brotli", row_group_size=7
    )
    return Variant(content, suffix=".parquet")
