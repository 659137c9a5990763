"""Thirty small recordings of other people's machines, in the styles in which controllers, recorders, printers
and programs write them: what each column is, so that a proposal can be judged. Zones of the first order under
on-off or PI control, in plain Python; nothing here comes from pipeline/.
"""

import math
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from itertools import pairwise
from typing import NamedTuple

import numpy as np

# What a column is. A melt temperature may be an output or be left out; a load (torque, a wanted speed beside
# the measured one) may be a disturbance or be left out; the others allow one role. Pressures, counters,
# states, alarms, power meters and positions are ignored.
ROLES = ("time", "output", "setpoint", "input", "disturbance", "ignore", "melt", "load")
CELSIUS, FAHRENHEIT = (1.0, 0.0), (5 / 9, -160 / 9)


class Column(NamedTuple):
    """A column of a recording: its name as it stands in the file, its role and its cells as they are written.
    `scale`: factor and offset to degC or percent where the owner needs them right, or None. `moving`: False
    if it is constant (a disturbance that never moves may be left out). `speed`: of a screw, a fan or a feed,
    which must never be an input."""

    name: str
    role: str
    cells: list[str]
    scale: tuple[float, float] | None = None
    moving: bool = True
    speed: bool = False
    number: bool = True


class Recording(NamedTuple):
    """A file: its columns, the seconds between its rows, and its bytes."""

    columns: list[Column]
    step_s: float
    content: bytes


class Header(NamedTuple):
    """A row of the table. `remedy`: what a refusal must say to be of use, where refusing is fair at all."""

    name: str
    vendor: str
    file: str
    make: Callable[[np.random.Generator], Recording]
    remedy: str = ""


# ---- machines


class Zone(NamedTuple):
    """degC a percent of duty, seconds, and the set-points one after the other; `law` is pi, onoff or split
    (heating and cooling by one PI)."""

    gain: float
    tau_s: float
    targets: tuple[float, ...]
    law: str = "pi"
    delay_s: float = 10.0


class Run(NamedTuple):
    """Columns (one array of each zone): set-point, temperature, duty of the heater and of the cooling valve
    in percent; and the melt's temperature."""

    target: list[np.ndarray]
    temperature: list[np.ndarray]
    duty: list[np.ndarray]
    cooling: list[np.ndarray]
    melt: np.ndarray


def staircase(rng: np.random.Generator, rows: int, levels: Sequence[float]) -> np.ndarray:
    """These levels one after the other, each for about as long as the others."""
    inner = np.arange(1, len(levels)) / len(levels) + rng.uniform(-0.06, 0.06, len(levels) - 1)
    edges = [0, *(inner * rows).astype(int), rows]
    return np.concatenate(
        [np.full(b - a, float(x)) for (a, b), x in zip(pairwise(edges), levels, strict=True)]
    )


def drift(rng: np.random.Generator, rows: int, level: float = 22.0, span: float = 2.5) -> np.ndarray:
    """The temperature of a room: a slow wave and a walk."""
    phase = rng.uniform(0, 2 * math.pi)
    wave = np.sin(phase + np.linspace(0, 3 * math.pi, rows))
    return level + 0.5 * span * wave + np.cumsum(rng.standard_normal(rows)) * 0.2 * span / math.sqrt(rows)


def simulate(
    rng: np.random.Generator,
    rows: int,
    step_s: float,
    zones: Sequence[Zone],
    *,
    room: np.ndarray,
    push: np.ndarray | float = 0.0,
    start: float | None = None,
    noise: float = 0.08,
) -> Run:
    """The zones in a row, each drawn to its neighbours; `push`: degC by which screw, fan or feed move them at
    rest. They begin at `start`, or at their first set-points."""
    count = len(zones)
    push = np.broadcast_to(np.asarray(push, float), (rows,)).tolist()
    air = room.tolist()
    targets = [staircase(rng, rows, zone.targets) for zone in zones]
    wanted = [target.tolist() for target in targets]
    T = [start if start is not None else zone.targets[0] for zone in zones]
    late = [[value] * (1 + round(zone.delay_s / step_s)) for value, zone in zip(T, zones, strict=True)]
    share = [1 - math.exp(-step_s / zone.tau_s) for zone in zones]
    gains = [zone.tau_s / (zone.gain * (2 * zone.delay_s + step_s + zone.tau_s / 10)) for zone in zones]
    resets = [min(zone.tau_s, 8 * (zone.delay_s + step_s) + zone.tau_s / 8) for zone in zones]
    rest = [max(0.0, (T[k] - air[0]) / zones[k].gain) if start is None else 0.0 for k in range(count)]
    integral, on = rest, [False] * count
    hiss = (noise * rng.standard_normal((rows, count))).tolist()
    read, duty, cooling = ([[] for _ in zones] for _ in range(3))
    for t in range(rows):
        before = list(T)
        for k, zone in enumerate(zones):
            seen = late[k][0] + hiss[t][k]
            error = wanted[k][t] - seen
            if zone.law == "onoff":
                on[k] = error > 0.6 or (on[k] and error > -0.6)
                u = 100.0 if on[k] else 0.0
            else:
                low = -100.0 if zone.law == "split" else 0.0
                u = gains[k] * error + integral[k]
                if low < u < 100 or (u >= 100 and error < 0) or (u <= low and error > 0):
                    integral[k] += gains[k] * error * step_s / resets[k]
                u = min(100.0, max(low, u))
            heat, cool = max(u, 0.0), max(-u, 0.0)
            beside = [before[j] for j in (k - 1, k + 1) if 0 <= j < count]
            pull = 0.12 * sum(other - before[k] for other in beside)
            steady = air[t] + zone.gain * (heat - 0.6 * cool) + push[t] + pull
            T[k] = before[k] + share[k] * (steady - before[k])
            late[k] = [*late[k][1:], T[k]]
            read[k].append(seen)
            duty[k].append(heat)
            cooling[k].append(cool)
    last = np.array(read[-1])
    melt = last + 4 + 0.3 * np.asarray(push) + 0.3 * rng.standard_normal(rows)
    return Run(targets, *([np.array(one) for one in many] for many in (read, duty, cooling)), melt)


def barrel(count: int, *, low: float = 175.0, law: str = "pi", steps: int = 3) -> list[Zone]:
    """An extruder's zones from the feed to the die."""
    levels = [low + 7.5 * k for k in range(count)]
    shifts = (0, 6, -5, 9)[:steps]
    return [
        Zone(3.2 + 0.25 * k, 420 - 35 * k, tuple(x + s for s in shifts), law, 8.0 if law == "onoff" else 25.0)
        for k, x in enumerate(levels)
    ]


# ---- cells


def num(
    name: str,
    role: str,
    values: np.ndarray,
    decimals: int = 1,
    *,
    scale: tuple[float, float] | None = None,
    speed: bool = False,
) -> Column:
    """A column of numbers with so many decimals."""
    cells = [f"{value:.{decimals}f}" for value in np.asarray(values, float).tolist()]
    if scale is None and role == "output":
        scale = CELSIUS
    return Column(name, role, cells, scale, len(set(cells)) > 1, speed)


def words(name: str, role: str, cells: Sequence[str]) -> Column:
    """A column of text."""
    return Column(name, role, list(cells), number=False)


def stamps(rows: int, step_s: float, form: str, *, start: str = "2024-03-05T14:22:01") -> list[str]:
    """The clock of the wall, in a form of strftime; %f is cut to milliseconds."""
    first = datetime.fromisoformat(start)
    told = [first + timedelta(seconds=step_s * k) for k in range(rows)]
    return [at.strftime(form.replace("%f", "@")).replace("@", f"{at.microsecond // 1000:03d}") for at in told]


def seconds(rows: int, step_s: float) -> np.ndarray:
    return step_s * np.arange(rows)


def lines(
    columns: Sequence[Column], sep: str, *, comma: bool = False, quoted: bool = False, head: bool = True
) -> list[str]:
    """The header, if wanted, and the rows."""
    written = []
    for column in columns:
        cells = [cell.replace(".", ",") for cell in column.cells] if comma and column.number else column.cells
        cells = [f'"{cell}"' for cell in cells] if quoted and not column.number else cells
        name = f'"{column.name}"' if quoted or sep in column.name else column.name
        written.append([name, *cells] if head else cells)
    return [sep.join(row) for row in zip(*written, strict=True)]


def text(rows: Sequence[str], *, end: str = "\n", encoding: str = "utf-8") -> bytes:
    return (end.join(rows) + end).encode(encoding)


def pressure(rng: np.random.Generator, speed: np.ndarray, *, a_rpm: float = 1.6) -> np.ndarray:
    """Of the melt, in bar."""
    return 20 + a_rpm * speed + 0.8 * rng.standard_normal(len(speed))


def energy(run: Run, step_s: float, watts: float = 1200.0) -> np.ndarray:
    """A counter in kWh."""
    return 1834.2 + np.cumsum(sum(run.duty)) * watts / 100 * step_s / 3.6e6


# ---- controllers and recorders of plants


def siemens(rng: np.random.Generator) -> Recording:
    """A trace of a TIA project in German, with tags of a data block."""
    rows, step_s = 1800, 2.0
    speed, room = staircase(rng, rows, (40, 55, 48)), drift(rng, rows)
    run = simulate(rng, rows, step_s, barrel(4), room=room, push=0.25 * (speed - 45))
    columns = [words("Zeitstempel", "time", stamps(rows, step_s, "%d.%m.%Y %H:%M:%S"))]
    for k in range(4):
        columns += [
            num(f"DB10.Zone{k + 1}.Ist", "output", run.temperature[k]),
            num(f"DB10.Zone{k + 1}.Soll", "setpoint", run.target[k]),
            num(f"DB10.Zone{k + 1}.Stellgrad", "input", run.duty[k], scale=(1, 0)),
        ]
    columns += [
        num("DB20.Schnecke.Drehzahl_Ist", "disturbance", speed + 0.1 * rng.standard_normal(rows), speed=True),
        num("DB20.Massedruck", "ignore", pressure(rng, speed)),
        num("DB1.Stoerung_Aktiv", "ignore", np.zeros(rows), 0),
    ]
    return Recording(columns, step_s, text(lines(columns, ";", comma=True), end="\r\n"))


def beckhoff(rng: np.random.Generator) -> Recording:
    """TwinCAT Scope: a block of lines about the project, then tabs; milliseconds; duty as a share."""
    rows, step_s = 3000, 0.5
    speed, room = np.full(rows, 62.0), drift(rng, rows)
    zones = [Zone(3.1, 120, (185, 192, 188), delay_s=6), Zone(3.4, 95, (195, 190, 200), delay_s=5)]
    run = simulate(rng, rows, step_s, zones, room=room, noise=0.03)
    columns = [num("Time [ms]", "time", 1000 * seconds(rows, step_s), 0)]
    for k in range(2):
        zone = f"GVL_Heating.aZone[{k + 1}]"
        columns += [
            num(f"{zone}.fTempAct", "output", run.temperature[k], 3),
            num(f"{zone}.fTempSet", "setpoint", run.target[k], 3),
            num(f"{zone}.fHeatOut", "input", run.duty[k] / 100, 5, scale=(100, 0)),
        ]
    columns += [
        num("GVL_Drive.fScrewSpeedAct", "disturbance", speed, 3, speed=True),
        num("GVL_Room.fAmbientTemp", "disturbance", room, 3),
        num("GVL_Heating.nState", "ignore", np.full(rows, 3), 0),
    ]
    block = ["Name\tExtruderScope", "File\tC:\\TwinCAT\\Scope\\ExtruderScope.svdx"]
    block += ["Starttime of export\tTuesday, 5 March 2024 14:22:01", ""]
    return Recording(columns, step_s, text(block + lines(columns, "\t"), end="\r\n"))


def b_and_r(rng: np.random.Generator) -> Recording:
    """An export of mapp with the names of structures; seconds; heating and cooling apart."""
    rows, step_s = 1500, 2.0
    speed, room = staircase(rng, rows, (30, 42, 36, 45)), drift(rng, rows)
    run = simulate(rng, rows, step_s, barrel(3, law="split"), room=room, push=0.8 * (speed - 30), noise=0.05)
    columns = [num("Time [s]", "time", seconds(rows, step_s), 3)]
    for k in range(3):
        zone = f"Extruder.Zone[{k + 1}]"
        columns += [
            num(f"{zone}.ActTemp", "output", run.temperature[k], 2),
            num(f"{zone}.SetTemp", "setpoint", run.target[k], 2),
            num(f"{zone}.HeatOut", "input", run.duty[k], 2, scale=(1, 0)),
            num(f"{zone}.CoolOut", "input", run.cooling[k], 2, scale=(1, 0)),
            num(f"{zone}.AlarmActive", "ignore", np.zeros(rows), 0),
        ]
    columns += [
        num("Extruder.Screw.ActSpeed", "disturbance", speed, 2, speed=True),
        num("Extruder.Screw.SetSpeed", "load", speed, 1, speed=True),
        num("Extruder.MeltPressure", "ignore", pressure(rng, speed), 2),
    ]
    return Recording(columns, step_s, text(lines(columns, ","), end="\r\n"))


def allen_bradley(rng: np.random.Generator) -> Recording:
    """RSTrendX of a plant in Brazil: addresses in one row, what they are in the next, without accents."""
    rows, step_s = 1600, 2.0
    speed, room = staircase(rng, rows, (50, 58)), drift(rng, rows, 29)
    run = simulate(rng, rows, step_s, barrel(3, low=160), room=room, push=0.3 * (speed - 50))
    columns = [
        words("Data", "time", stamps(rows, step_s, "%d/%m/%Y")),
        words("Hora", "time", stamps(rows, step_s, "%H:%M:%S")),
    ]
    address = ["", ""]
    for k in range(3):
        address += [f"F8:{k}", f"N7:{k}", f"F8:{10 + k}"]
        columns += [
            num(f"Zona {k + 1} Temp Atual", "output", run.temperature[k]),
            num(f"Zona {k + 1} Temp Ajuste", "setpoint", run.target[k], 0),
            num(f"Zona {k + 1} Saida Aquecimento", "input", run.duty[k], scale=(1, 0)),
        ]
    address += ["N7:20", "N7:21", "B3:0/1"]
    columns += [
        num("Rotacao Rosca RPM", "disturbance", speed, 0, speed=True),
        num("Pressao Massa", "ignore", pressure(rng, speed), 0),
        num("Alarme Geral", "ignore", np.zeros(rows), 0),
    ]
    block = ["Controller Name:,EXTR_SLC505", "Trend Name:,Zonas", ",".join(address)]
    return Recording(columns, step_s, text(block + lines(columns, ","), end="\r\n"))


def omron(rng: np.random.Generator) -> Recording:
    """CX-Supervisor in French without accents: words of the memory beside names."""
    rows, step_s = 1500, 3.0
    speed, room = np.full(rows, 75.0), drift(rng, rows, 24, 4)
    run = simulate(rng, rows, step_s, barrel(3, law="onoff"), room=room)
    columns = [
        words("Date", "time", stamps(rows, step_s, "%d/%m/%Y")),
        words("Heure", "time", stamps(rows, step_s, "%H:%M:%S")),
    ]
    for k in range(3):
        columns += [
            num(f"D{100 + k} Mesure_Zone{k + 1}", "output", run.temperature[k]),
            num(f"D{110 + k} Consigne_Zone{k + 1}", "setpoint", run.target[k]),
            num(f"W0.0{k} Chauffe_Zone{k + 1}", "input", run.duty[k] > 0, 0, scale=(100, 0)),
        ]
    columns += [
        num("D120 Vitesse_Vis", "disturbance", speed, 0, speed=True),
        num("D130 Temp_Ambiante", "disturbance", room),
        num("D140 Compteur_Pieces", "ignore", np.arange(rows) // 40, 0),
        num("D150 Defaut", "ignore", np.zeros(rows), 0),
    ]
    return Recording(columns, step_s, text(lines(columns, ";", comma=True), end="\r\n"))


def eurotherm(rng: np.random.Generator) -> Recording:
    """iTools: the parameters of two loops under their OPC names."""
    rows, step_s = 1400, 1.0
    room = drift(rng, rows)
    zones = [Zone(2.8, 160, (150, 165, 158), delay_s=8), Zone(3.0, 140, (180, 172, 185), delay_s=8)]
    run = simulate(rng, rows, step_s, zones, room=room, start=23.0)
    columns = [words("Date/Time", "time", stamps(rows, step_s, "%Y-%m-%d %H:%M:%S"))]
    for k in range(2):
        loop = f"Loop.{k + 1}"
        columns += [
            num(f"{loop}.Main.PV", "output", run.temperature[k], 2),
            num(f"{loop}.Main.TargetSP", "setpoint", run.target[k], 2),
            num(f"{loop}.SP.WorkingSP", "setpoint", run.target[k], 2),
            num(f"{loop}.OP.Ch1Out", "input", run.duty[k], 2, scale=(1, 0)),
            num(f"{loop}.Main.AutoMan", "ignore", np.zeros(rows), 0),
        ]
    columns += [num("AI.3.PV_Ambient", "disturbance", room, 2)]
    return Recording(columns, step_s, text(lines(columns, ","), end="\r\n"))


def gefran(rng: np.random.Generator) -> Recording:
    """GF_eXpress in Italian, with accents and units in brackets."""
    rows, step_s = 1500, 2.0
    speed, room = staircase(rng, rows, (35, 44, 38)), drift(rng, rows, 21)
    run = simulate(rng, rows, step_s, barrel(3), room=room, push=0.4 * (speed - 38))
    columns = [
        words("Data", "time", stamps(rows, step_s, "%d/%m/%Y")),
        words("Ora", "time", stamps(rows, step_s, "%H:%M:%S")),
    ]
    for k in range(3):
        columns += [
            num(f"Temperatura zona {k + 1} (°C)", "output", run.temperature[k]),
            num(f"Setpoint zona {k + 1} (°C)", "setpoint", run.target[k]),
            num(f"Potenza zona {k + 1} (%)", "input", run.duty[k], scale=(1, 0)),
        ]
    columns += [
        num("Velocità vite (giri/min)", "disturbance", speed, speed=True),
        num("Pressione fuso (bar)", "ignore", pressure(rng, speed)),
        num("Temperatura fuso (°C)", "melt", run.melt),
        num("Temperatura ambiente (°C)", "disturbance", room),
        words("Stato", "ignore", ["Marcia"] * rows),
    ]
    return Recording(columns, step_s, text(lines(columns, ";", comma=True), end="\r\n"))


def jumo(rng: np.random.Generator) -> Recording:
    """A paperless recorder in Polish with accents: the units stand in the second row."""
    rows, step_s = 1300, 5.0
    speed, room = staircase(rng, rows, (60, 70, 64)), drift(rng, rows, 20)
    run = simulate(rng, rows, step_s, barrel(3, low=165), room=room, push=0.3 * (speed - 64))
    columns, units = [words("Data i czas", "time", stamps(rows, step_s, "%Y-%m-%d %H:%M:%S"))], [""]
    for k in range(3):
        columns += [
            num(f"Temperatura strefy {k + 1}", "output", run.temperature[k]),
            num(f"Wartość zadana strefy {k + 1}", "setpoint", run.target[k]),
            num(f"Moc grzania strefy {k + 1}", "input", run.duty[k], scale=(1, 0)),
        ]
        units += ["°C", "°C", "%"]
    columns += [
        num("Prędkość ślimaka", "disturbance", speed, 0, speed=True),
        num("Ciśnienie stopu", "ignore", pressure(rng, speed)),
        num("Temperatura otoczenia", "disturbance", room),
    ]
    units += ["obr/min", "bar", "°C"]
    head, *body = lines(columns, ";", comma=True)
    return Recording(columns, step_s, text([head, ";".join(units), *body], end="\r\n"))


def yokogawa(rng: np.random.Generator) -> Recording:
    """CENTUM: tags with PV, SV and MV, the units in the row after them."""
    rows, step_s = 1500, 2.0
    speed, room = staircase(rng, rows, (80, 92)), drift(rng, rows)
    run = simulate(rng, rows, step_s, barrel(4, steps=4), room=room, push=0.2 * (speed - 85))
    columns, units = [words("Timestamp", "time", stamps(rows, step_s, "%Y/%m/%d %H:%M:%S"))], [""]
    for k in range(4):
        tag = f"TIC{101 + k}"
        columns += [
            num(f"{tag}.PV", "output", run.temperature[k]),
            num(f"{tag}.SV", "setpoint", run.target[k]),
            num(f"{tag}.MV", "input", run.duty[k], scale=(1, 0)),
        ]
        units += ["DEGC", "DEGC", "%"]
    columns += [
        num("SIC201.PV", "disturbance", speed + 0.05 * rng.standard_normal(rows), speed=True),
        num("PI301.PV", "ignore", pressure(rng, speed) / 10, 2),
    ]
    units += ["RPM", "MPA"]
    head, *body = lines(columns, ",")
    return Recording(columns, step_s, text([head, ",".join(units), *body], end="\r\n"))


def omega(rng: np.random.Generator) -> Recording:
    """A logger with thermocouples in degrees Fahrenheit, behind a block of lines about the instrument."""
    rows, step_s = 1200, 3.0
    speed, room = staircase(rng, rows, (25, 32, 28)), drift(rng, rows)
    run = simulate(rng, rows, step_s, barrel(2, low=190), room=room, push=0.6 * (speed - 28))
    columns = [
        words("Date", "time", stamps(rows, step_s, "%m/%d/%Y")),
        words("Time", "time", stamps(rows, step_s, "%H:%M:%S")),
    ]
    for k in range(2):
        columns += [
            num(
                f"CH{k + 1} Barrel Zone {k + 1} (F)",
                "output",
                32 + 1.8 * run.temperature[k],
                scale=FAHRENHEIT,
            ),
            num(f"CH{k + 3} Zone {k + 1} Setpoint (F)", "setpoint", 32 + 1.8 * run.target[k]),
            num(f"CH{k + 5} Zone {k + 1} SSR Output (%)", "input", run.duty[k], scale=(1, 0)),
        ]
    columns += [
        num("CH7 Screw Speed (RPM)", "disturbance", speed, speed=True),
        num("CH8 Ambient (F)", "disturbance", 32 + 1.8 * room, scale=FAHRENHEIT),
        num("CH9 Melt Pressure (PSI)", "ignore", 14.5 * pressure(rng, speed), 0),
    ]
    block = ["Omega OM-DAQPRO-5300", "Serial Number:,1130457", "Sampling Rate:,3 s", ""]
    return Recording(columns, step_s, text(block + lines(columns, ","), end="\r\n"))


# ---- makers of extruders


def krauss_maffei(rng: np.random.Generator) -> Recording:
    """In German with umlauts: six columns beside those of the zones."""
    rows, step_s = 1500, 2.0
    speed, room = staircase(rng, rows, (90, 105, 98)), drift(rng, rows, 25)
    run = simulate(rng, rows, step_s, barrel(5), room=room, push=0.15 * (speed - 98))
    columns = [words("Datum/Uhrzeit", "time", stamps(rows, step_s, "%d.%m.%Y %H:%M:%S"))]
    for k in range(5):
        columns += [
            num(f"Zylinderzone {k + 1} Istwert [°C]", "output", run.temperature[k]),
            num(f"Zylinderzone {k + 1} Sollwert [°C]", "setpoint", run.target[k]),
            num(f"Zylinderzone {k + 1} Heizleistung [%]", "input", run.duty[k], scale=(1, 0)),
        ]
    torque = 58 + 0.2 * (speed - 98) + rng.standard_normal(rows)
    columns += [
        num("Schneckendrehzahl [1/min]", "disturbance", speed, speed=True),
        num("Drehmoment [%]", "load", torque),
        num("Massedruck [bar]", "ignore", pressure(rng, speed)),
        num("Massetemperatur [°C]", "melt", run.melt),
        num("Umgebungstemperatur [°C]", "disturbance", room),
        num("Zähler Störungen", "ignore", np.zeros(rows), 0),
    ]
    return Recording(columns, step_s, text(lines(columns, ";", comma=True), end="\r\n"))


def battenfeld(rng: np.random.Generator) -> Recording:
    """Short German names, no units at all."""
    rows, step_s = 1400, 2.0
    speed, room = np.full(rows, 85.0), drift(rng, rows)
    run = simulate(rng, rows, step_s, barrel(4, low=170), room=room)
    columns = [words("ZEIT", "time", stamps(rows, step_s, "%d.%m.%Y %H:%M:%S"))]
    for k in range(4):
        columns += [
            num(f"T{k + 1}_IST", "output", run.temperature[k]),
            num(f"T{k + 1}_SOLL", "setpoint", run.target[k], 0),
            num(f"Y{k + 1}", "input", run.duty[k], 0, scale=(1, 0)),
        ]
    columns += [
        num("N_SCHNECKE", "disturbance", speed, 0, speed=True),
        num("P_MASSE", "ignore", pressure(rng, speed), 0),
        num("T_MASSE", "melt", run.melt),
    ]
    return Recording(columns, step_s, text(lines(columns, ";", comma=True), end="\r\n"))


def reifenhaeuser(rng: np.random.Generator) -> Recording:
    """German in Latin-1, heating and cooling of each zone, a haul-off."""
    rows, step_s = 1400, 2.0
    speed, room = staircase(rng, rows, (110, 125, 118)), drift(rng, rows)
    pull = staircase(rng, rows, (12.0, 14.5))
    run = simulate(rng, rows, step_s, barrel(3, law="split"), room=room, push=0.9 * (speed - 110))
    columns = [
        words("Datum", "time", stamps(rows, step_s, "%d.%m.%Y")),
        words("Uhrzeit", "time", stamps(rows, step_s, "%H:%M:%S")),
    ]
    for k in range(3):
        columns += [
            num(f"HZ{k + 1} Ist (°C)", "output", run.temperature[k]),
            num(f"HZ{k + 1} Soll (°C)", "setpoint", run.target[k]),
            num(f"HZ{k + 1} Heizen (%)", "input", run.duty[k], scale=(1, 0)),
            num(f"HZ{k + 1} Kühlen (%)", "input", run.cooling[k], scale=(1, 0)),
        ]
    columns += [
        num("Extruder Drehzahl (U/min)", "disturbance", speed, speed=True),
        num("Abzugsgeschwindigkeit (m/min)", "disturbance", pull, speed=True),
        num("Druck vor Sieb (bar)", "ignore", pressure(rng, speed)),
        num("Energiezähler (kWh)", "ignore", energy(run, step_s), 2),
    ]
    return Recording(columns, step_s, text(lines(columns, ";", comma=True), end="\r\n", encoding="latin-1"))


def leistritz(rng: np.random.Generator) -> Recording:
    """A twin screw of a laboratory in the Netherlands: Dutch, a feeder, tabs."""
    rows, step_s = 1500, 2.0
    speed, feed = staircase(rng, rows, (200, 240, 220)), staircase(rng, rows, (2.0, 2.6, 2.2, 2.8))
    room = drift(rng, rows, 20)
    run = simulate(
        rng, rows, step_s, barrel(4, low=150), room=room, push=0.05 * (speed - 220) - 3 * (feed - 2)
    )
    columns = [words("Tijd", "time", stamps(rows, step_s, "%d-%m-%Y %H:%M:%S"))]
    for k in range(4):
        columns += [
            num(f"Zone {k + 2} gemeten [°C]", "output", run.temperature[k]),
            num(f"Zone {k + 2} gewenst [°C]", "setpoint", run.target[k]),
            num(f"Zone {k + 2} verwarming [%]", "input", run.duty[k], scale=(1, 0)),
        ]
    columns += [
        num("Toerental schroef [tpm]", "disturbance", speed, 0, speed=True),
        num("Doseersnelheid [kg/h]", "disturbance", feed + 0.02 * rng.standard_normal(rows), 2, speed=True),
        num("Koppel [%]", "load", 45 + 4 * feed + rng.standard_normal(rows)),
        num("Smeltdruk [bar]", "ignore", pressure(rng, speed, a_rpm=0.2)),
        num("Omgevingstemperatuur [°C]", "disturbance", room),
    ]
    return Recording(columns, step_s, text(lines(columns, "\t", comma=True), end="\r\n"))


# ---- printers


class Print(NamedTuple):
    """A printer's run: hot end and bed, part fan in percent, feed in mm/s, the room."""

    run: Run
    fan: np.ndarray
    feed: np.ndarray
    room: np.ndarray


def printed(
    rng: np.random.Generator,
    rows: int,
    step_s: float,
    *,
    hot: tuple[float, ...] = (0, 205, 215, 210),
    bed: tuple[float, ...] = (0, 60, 55),
    chamber: tuple[float, ...] = (),
) -> Print:
    """From cold through a few temperatures."""
    fan, feed = staircase(rng, rows, (0, 0, 100, 40, 80)), staircase(rng, rows, (0, 3.2, 1.8, 4.1))
    room = drift(rng, rows)
    zones = [Zone(3.4, 55, hot, delay_s=2.0)]
    runs = [simulate(rng, rows, step_s, zones, room=room, push=-0.05 * fan - 1.5 * feed, start=22.0)]
    runs += [simulate(rng, rows, step_s, [Zone(1.1, 220, bed, delay_s=4.0)], room=room, start=22.0)]
    if chamber:
        runs.append(
            simulate(rng, rows, step_s, [Zone(0.7, 300, chamber, "onoff", 8.0)], room=room, start=22.0)
        )
    together = Run(*(sum((run[i] for run in runs), []) for i in range(4)), runs[0].melt)
    return Print(together, fan, feed, room)


def reprap(rng: np.random.Generator) -> Recording:
    """RepRapFirmware: keys of the object model polled into a CSV; duty and fan as shares."""
    rows, step_s = 2400, 0.5
    made = printed(rng, rows, step_s)
    columns = [num("upTime", "time", 812 + seconds(rows, step_s), 1)]
    for k in (1, 0):  # heater 0 is the bed
        heater = f"heat.heaters[{1 - k}]"
        columns += [
            num(f"{heater}.current", "output", made.run.temperature[k], 2),
            num(f"{heater}.active", "setpoint", made.run.target[k], 0),
            num(f"{heater}.avgPwm", "input", made.run.duty[k] / 100, 3, scale=(100, 0)),
        ]
    columns += [
        num("fans[0].actualValue", "disturbance", made.fan / 100, 2, speed=True),
        num("move.currentMove.extrusionRate", "disturbance", made.feed, 2, speed=True),
        num("move.axes[2].machinePosition", "ignore", 0.2 + 0.2 * (np.arange(rows) // 60), 2),
        num("boards[0].vIn.current", "ignore", 24.1 + 0.05 * rng.standard_normal(rows), 1),
        num("boards[0].mcuTemp.current", "ignore", 38 + 0.3 * rng.standard_normal(rows), 1),
    ]
    return Recording(columns, step_s, text(lines(columns, ",")))


def marlin(rng: np.random.Generator) -> Recording:
    """M155 S1 as a terminal captures it, each line behind the clock of the computer."""
    rows, step_s = 1500, 1.0
    made = printed(rng, rows, step_s)
    clock = seconds(rows, step_s) + 1709648521.5
    columns = [num("time", "time", clock, 3)]
    names = (("tool", "T"), ("bed", "B"))
    for k, (device, letter) in enumerate(names):
        columns += [
            num(f"{device}|{letter}|{letter}0", "output", made.run.temperature[k], 2),
            num(f"{device}.target|/{letter}|{letter}_target", "setpoint", made.run.target[k], 2),
            num(f"{device}.pwm|{'' if letter == 'T' else letter}@", "input", 1.27 * made.run.duty[k], 0),
        ]
    time, t, t_set, t_pwm, b, b_set, b_pwm = (column.cells for column in columns)
    rows_ = zip(time, t, t_set, b, b_set, t_pwm, b_pwm, strict=True)
    said = [f"{a}  T:{c} /{d} B:{e} /{f} @:{g} B@:{h}" for a, c, d, e, f, g, h in rows_]
    said.insert(400, f"{time[400]} echo:busy: processing")
    return Recording(columns, step_s, text(said))


def octoprint(rng: np.random.Generator) -> Recording:
    """A plugin's table with the names of OctoPrint's API."""
    rows, step_s = 1500, 1.0
    made = printed(rng, rows, step_s)
    columns = [words("timestamp", "time", stamps(rows, step_s, "%Y-%m-%dT%H:%M:%S.%f"))]
    for k, device in enumerate(("tool0", "bed")):
        columns += [
            num(f"{device}_actual", "output", made.run.temperature[k], 2),
            num(f"{device}_target", "setpoint", made.run.target[k]),
            num(f"{device}_power", "input", made.run.duty[k], scale=(1, 0)),
        ]
    columns += [
        num("fan_speed", "disturbance", made.fan, 0, speed=True),
        num("progress", "ignore", np.linspace(0, 100, rows), 2),
        words("state", "ignore", ["Printing"] * rows),
        num("current_z", "ignore", 0.2 + 0.2 * (np.arange(rows) // 60), 2),
    ]
    return Recording(columns, step_s, text(lines(columns, ",")))


def klipper(rng: np.random.Generator) -> Recording:
    """The table that a script makes of klippy.log, for plotting."""
    rows, step_s = 1800, 1.0
    made = printed(rng, rows, step_s, hot=(0, 240, 250, 245), bed=(0, 100, 95))
    columns = [num("#sampletime", "time", 3411.2 + seconds(rows, step_s), 3)]
    for k, device in enumerate(("extruder", "heater_bed")):
        columns += [
            num(f"{device}:temp", "output", made.run.temperature[k]),
            num(f"{device}:target", "setpoint", made.run.target[k], 0),
            num(f"{device}:pwm", "input", made.run.duty[k] / 100, 3, scale=(100, 0)),
        ]
    columns += [
        num("fan:speed", "disturbance", made.fan / 100, 2, speed=True),
        num("temperature_sensor chamber:temp", "disturbance", made.room + 6),
        num("mcu:temp", "ignore", 41 + 0.3 * rng.standard_normal(rows)),
        num("sysload", "ignore", 0.4 + 0.05 * np.abs(rng.standard_normal(rows)), 2),
        num("print_time", "ignore", 120 + seconds(rows, step_s), 3),
        num("buffer_time", "ignore", 2 + 0.2 * rng.standard_normal(rows), 3),
    ]
    return Recording(columns, step_s, text(lines(columns, ",")))


def prusa(rng: np.random.Generator) -> Recording:
    """Metrics of Buddy in one table, with the names of the firmware; milliseconds; PWM in 0 to 255."""
    rows, step_s = 1800, 1.0
    made = printed(rng, rows, step_s, hot=(0, 215, 230, 220))
    columns = [num("timestamp_ms", "time", 61200 + 1000 * seconds(rows, step_s), 0)]
    for k, device in enumerate(("noz", "bed")):
        columns += [
            num(f"temp_{device}", "output", made.run.temperature[k], 2),
            num(f"ttemp_{device}", "setpoint", made.run.target[k], 0),
            num(f"pwm_{device}", "input", 2.55 * made.run.duty[k], 0, scale=(1 / 2.55, 0)),
        ]
    columns += [
        num("print_fan_rpm", "disturbance", 48 * made.fan + 5 * (made.fan > 0), 0, speed=True),
        num("hbr_fan_rpm", "disturbance", np.full(rows, 7200), 0, speed=True),
        num("temp_amb", "disturbance", made.room, 2),
        num("temp_mcu", "ignore", 44 + 0.3 * rng.standard_normal(rows), 0),
        num("pos_z", "ignore", 0.2 + 0.2 * (np.arange(rows) // 60), 2),
        num("volt_bed", "ignore", 24.0 + 0.05 * rng.standard_normal(rows), 3),
        num("fsensor", "ignore", np.ones(rows), 0),
    ]
    return Recording(columns, step_s, text(lines(columns, ",")))


def bambu(rng: np.random.Generator) -> Recording:
    """Reports over MQTT made into a table, with the duty of both heaters beside them."""
    rows, step_s = 1600, 1.0
    made = printed(rng, rows, step_s, hot=(0, 220, 230, 225), bed=(0, 65, 55))
    columns = [words("ts", "time", stamps(rows, step_s, "%Y-%m-%dT%H:%M:%SZ"))]
    for k, device in enumerate(("nozzle", "bed")):
        columns += [
            num(f"print.{device}_temper", "output", made.run.temperature[k], 2),
            num(f"print.{device}_target_temper", "setpoint", made.run.target[k], 0),
            num(f"{device}_heater_duty", "input", made.run.duty[k], scale=(1, 0)),
        ]
    columns += [
        num("print.chamber_temper", "disturbance", made.room + 8, 1),
        num("print.cooling_fan_speed", "disturbance", np.round(made.fan * 0.15), 0, speed=True),
        num("print.heatbreak_fan_speed", "disturbance", np.full(rows, 15), 0, speed=True),
        num("print.mc_percent", "ignore", np.linspace(0, 99, rows), 0),
        num("print.layer_num", "ignore", np.arange(rows) // 60, 0),
        words("print.wifi_signal", "ignore", ["-47dBm"] * rows),
        words("print.gcode_state", "ignore", ["RUNNING"] * rows),
    ]
    return Recording(columns, step_s, text(lines(columns, ",")))


# ---- programs and laboratories


def labview(rng: np.random.Generator) -> Recording:
    """A measurement file in French with accents: two heads, tabs, decimal commas, a column for comments."""
    rows, step_s = 1500, 1.0
    room = drift(rng, rows, 19)
    zones = [Zone(2.6, 180, (140, 155, 148), delay_s=6), Zone(2.9, 150, (165, 160, 172), "onoff", 6)]
    run = simulate(rng, rows, step_s, zones, room=room, noise=0.04)
    columns = [num("X_Value", "time", seconds(rows, step_s), 6)]
    for k in range(2):
        columns += [
            num(f"Température zone {k + 1}", "output", run.temperature[k], 6),
            num(f"Consigne zone {k + 1}", "setpoint", run.target[k], 6),
            num(f"Puissance chauffe zone {k + 1}", "input", run.duty[k], 6, scale=(1, 0)),
        ]
    columns += [num("Température ambiante", "disturbance", room, 6)]
    count = len(columns) - 1
    block = ["LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab"]
    block += ["Decimal_Separator\t,", "Multi_Headings\tNo", "X_Columns\tOne", "Time_Pref\tRelative"]
    block += ["Operator\tlabo", "Date\t2024/03/05", "Time\t14:22:01,512", "***End_of_Header***\t", "\t"]
    block += [f"Channels\t{count}" + "\t" * count, "Samples" + f"\t{rows}" * count]
    block += ["Date" + "\t2024/03/05" * count, "X_Dimension" + "\tTime" * count]
    block += ["Delta_X" + "\t1,000000" * count, "***End_of_Header***" + "\t" * count]
    head, *body = lines(columns, "\t", comma=True)
    return Recording(columns, step_s, text([*block, head + "\tComment", *body], end="\r\n"))


def matlab(rng: np.random.Generator) -> Recording:
    """writetable after an experiment: the letters of a book on control."""
    rows, step_s = 1600, 1.0
    speed, room = staircase(rng, rows, (20, 26, 22)), drift(rng, rows)
    zones = [Zone(3.0, 130 + 20 * k, (150 + 10 * k, 158 + 9 * k, 153 + 12 * k), delay_s=6) for k in range(3)]
    run = simulate(rng, rows, step_s, zones, room=room, push=1.0 * (speed - 22), noise=0.05)
    columns = [num("t", "time", seconds(rows, step_s), 0)]
    columns += [num(f"y{k + 1}", "output", run.temperature[k], 4) for k in range(3)]
    columns += [num(f"r{k + 1}", "setpoint", run.target[k], 0) for k in range(3)]
    columns += [num(f"u{k + 1}", "input", run.duty[k], 4, scale=(1, 0)) for k in range(3)]
    columns += [num("n_screw", "disturbance", speed, 0, speed=True), num("T_amb", "disturbance", room, 4)]
    return Recording(columns, step_s, text(lines(columns, ",")))


def pandas_export(rng: np.random.Generator) -> Recording:
    """to_csv of tags of a historian: the index has no name and stands first."""
    rows, step_s = 1500, 2.0
    speed, room = staircase(rng, rows, (70, 78, 74)), drift(rng, rows)
    run = simulate(rng, rows, step_s, barrel(3), room=room, push=0.3 * (speed - 74))
    columns = [
        num("", "ignore", np.arange(rows), 0),
        words("timestamp", "time", stamps(rows, step_s, "%Y-%m-%d %H:%M:%S+00:00")),
    ]
    for k in range(3):
        columns += [
            num(f"TIC{101 + k}.PV", "output", run.temperature[k], 6),
            num(f"TIC{101 + k}.SP", "setpoint", run.target[k], 1),
            num(f"TIC{101 + k}.OP", "input", run.duty[k], 6, scale=(1, 0)),
        ]
    columns += [
        num("SIC201.PV", "disturbance", speed + 0.05 * rng.standard_normal(rows), 6, speed=True),
        num("PT301.PV", "ignore", pressure(rng, speed), 6),
        num("TI401_AMBIENT.PV", "disturbance", room, 6),
    ]
    return Recording(columns, step_s, text(lines(columns, ",")))


def arduino(rng: np.random.Generator) -> Recording:
    """What a sketch prints: a greeting, then milliseconds, and PWM in 0 to 255."""
    rows, step_s = 2400, 0.5
    feed, room = staircase(rng, rows, (0, 120, 80, 160)), drift(rng, rows)
    zone = Zone(3.4, 50, (185, 200, 190, 205), delay_s=2.0)
    run = simulate(rng, rows, step_s, [zone], room=room, push=-0.03 * feed, start=24.0, noise=0.15)
    columns = [
        num("millis", "time", 2013 + 1000 * seconds(rows, step_s), 0),
        num("nozzleTemp", "output", run.temperature[0], 2),
        num("setPoint", "setpoint", run.target[0], 2),
        num("heaterPWM", "input", 2.55 * run.duty[0], 0, scale=(1 / 2.55, 0)),
        num("feedStepsPerSec", "disturbance", feed, 0, speed=True),
        num("ambientTemp", "disturbance", room, 2),
        num("errorFlag", "ignore", np.zeros(rows), 0),
    ]
    greeting = ["Filament extruder v1.3", "MAX31855 ok"]
    return Recording(columns, step_s, text(greeting + lines(columns, ","), end="\r\n"))


def ros(rng: np.random.Generator) -> Recording:
    """A bag that PlotJuggler saved as CSV: topics with indices, seconds since 1970."""
    rows, step_s = 2000, 1.0
    speed, room = staircase(rng, rows, (15, 22, 18)), drift(rng, rows)
    zones = [Zone(3.0, 120 + 20 * k, (170 + 10 * k, 178 + 9 * k, 173 + 10 * k), delay_s=6) for k in range(3)]
    run = simulate(rng, rows, step_s, zones, room=room, push=0.8 * (speed - 18), noise=0.05)
    columns = [num("__time", "time", 1709648521.25 + seconds(rows, step_s), 6)]
    for topic, role, values in (
        ("zone_temps", "output", run.temperature),
        ("zone_setpoints", "setpoint", run.target),
        ("heater_cmd", "input", [duty / 100 for duty in run.duty]),
    ):
        scale = (100.0, 0.0) if role == "input" else None
        columns += [num(f"/extruder/{topic}.data[{k}]", role, values[k], 5, scale=scale) for k in range(3)]
    columns += [
        num("/extruder/screw_speed/data", "disturbance", speed, 3, speed=True),
        num("/extruder/melt_pressure/data", "ignore", pressure(rng, speed), 3),
        num("/room/temperature", "disturbance", room, 4),
        num("/joint_states/position[2]", "ignore", 0.001 * np.arange(rows) % 0.4, 5),
    ]
    return Recording(columns, step_s, text(lines(columns, ",")))


def influx(rng: np.random.Generator) -> Recording:
    """A pivoted query as annotated CSV, with field names in Portuguese without accents."""
    rows, step_s = 1300, 5.0
    speed, room = staircase(rng, rows, (45, 52, 48)), drift(rng, rows, 27)
    run = simulate(rng, rows, step_s, barrel(3, low=180), room=room, push=0.4 * (speed - 48))
    times = stamps(rows, step_s, "%Y-%m-%dT%H:%M:%SZ")
    columns = [
        words("", "ignore", [""] * rows),
        words("result", "ignore", ["_result"] * rows),
        num("table", "ignore", np.zeros(rows), 0),
        words("_time", "time", times),
        words("_measurement", "ignore", ["extrusora"] * rows),
        words("host", "ignore", ["linha2"] * rows),
    ]
    for k in range(3):
        columns += [
            num(f"temp_zona{k + 1}", "output", run.temperature[k], 2),
            num(f"ajuste_zona{k + 1}", "setpoint", run.target[k]),
            num(f"saida_zona{k + 1}", "input", run.duty[k], 2, scale=(1, 0)),
        ]
    columns += [
        num("velocidade_rosca", "disturbance", speed, speed=True),
        num("pressao_massa", "ignore", pressure(rng, speed)),
        num("temp_ambiente", "disturbance", room, 2),
    ]
    kinds = ["string", "long", "dateTime:RFC3339", "string", "string", *["double"] * (len(columns) - 6)]
    groups = ["false", "false", "false", "true", "true", *["false"] * (len(columns) - 6)]
    block = [f"#datatype,{','.join(kinds)}", f"#group,{','.join(groups)}"]
    block += ["#default,_result" + "," * (len(columns) - 2)]
    return Recording(columns, step_s, text(block + lines(columns, ","), end="\r\n"))


def home_assistant(rng: np.random.Generator) -> Recording:
    """A wide table of entities, some of them unavailable for a moment; a plug with a power meter."""
    rows, step_s = 1400, 5.0
    room = drift(rng, rows, 21, 3)
    fan = staircase(rng, rows, (0, 60, 100, 40))
    zones = [Zone(3.2, 160, (200, 215, 205, 210), delay_s=8), Zone(1.0, 380, (60, 65, 55), "onoff", 10)]
    runs = [
        simulate(rng, rows, step_s, [zone], room=room, push=p)
        for zone, p in zip(zones, (-0.06 * fan, 0), strict=True)
    ]
    watts = 8 + 0.4 * runs[0].duty[0] + 2.2 * runs[1].duty[0] + rng.standard_normal(rows)
    columns = [words("last_changed", "time", stamps(rows, step_s, "%Y-%m-%dT%H:%M:%S.%fZ"))]
    for run, device in zip(runs, ("hotend", "bed"), strict=True):
        columns += [
            num(f"sensor.printer_{device}_temperature", "output", run.temperature[0], 2),
            num(f"number.printer_{device}_target", "setpoint", run.target[0]),
            num(f"sensor.printer_{device}_heater_power", "input", run.duty[0], 0, scale=(1, 0)),
        ]
    columns += [
        num("fan.printer_part_cooling", "disturbance", fan, 0, speed=True),
        num("sensor.workshop_temperature", "disturbance", room),
        num("sensor.printer_plug_power", "ignore", watts),
        num("sensor.printer_plug_energy", "ignore", 212 + np.cumsum(watts) * step_s / 3.6e6, 3),
    ]
    for column in columns[1:]:
        column.cells[700:703] = ["unavailable"] * 3
    return Recording(columns, step_s, text(lines(columns, ",")))


def excel(rng: np.random.Generator) -> Recording:
    """Saved for Excel in Spanish with accents: sep=; first, a mark of the byte order before it."""
    rows, step_s = 1400, 2.0
    speed, room = staircase(rng, rows, (55, 63, 58)), drift(rng, rows, 26)
    run = simulate(rng, rows, step_s, barrel(3), room=room, push=0.4 * (speed - 58))
    columns = [
        words("Fecha", "time", stamps(rows, step_s, "%d/%m/%Y")),
        words("Hora", "time", stamps(rows, step_s, "%H:%M:%S")),
    ]
    for k in range(3):
        columns += [
            num(f"Temp. cañón zona {k + 1}", "output", run.temperature[k]),
            num(f"Consigna zona {k + 1}", "setpoint", run.target[k]),
            num(f"Salida calefacción zona {k + 1}", "input", run.duty[k], scale=(1, 0)),
        ]
    columns += [
        num("Velocidad husillo", "disturbance", speed, speed=True),
        num("Presión de masa", "ignore", pressure(rng, speed)),
        num("Contador de ciclos", "ignore", np.arange(rows) // 30, 0),
    ]
    body = lines(columns, ";", comma=True)
    return Recording(columns, step_s, text(["sep=;", *body], end="\r\n", encoding="utf-8-sig"))


def syringe(rng: np.random.Generator) -> Recording:
    """A stand for a heated syringe of a bioprinter; heaters in watts."""
    rows, step_s = 1600, 1.0
    speed, room = staircase(rng, rows, (0, 0.02, 0.05, 0.03)), drift(rng, rows, 22, 2)
    zones = [Zone(0.6, 240, (37, 42, 39), delay_s=5), Zone(0.7, 110, (40, 37, 43), delay_s=4)]
    run = simulate(rng, rows, step_s, zones, room=room, push=-20 * speed, noise=0.02)
    columns = [num("elapsed_s", "time", seconds(rows, step_s), 1)]
    for k, (part, watts) in enumerate((("barrel", 30), ("needle", 8))):
        columns += [
            num(f"{part}_temp_C", "output", run.temperature[k], 3),
            num(f"{part}_setpoint_C", "setpoint", run.target[k], 1),
            num(f"{part}_heater_W", "input", watts / 100 * run.duty[k], 3),
        ]
    force = 12 + 90 * speed + 0.2 * rng.standard_normal(rows)
    columns += [
        num("plunger_speed_mm_s", "disturbance", speed, 3, speed=True),
        num("plunger_position_mm", "ignore", np.cumsum(speed) * step_s, 3),
        num("force_N", "ignore", force, 2),
        num("ambient_C", "disturbance", room, 2),
    ]
    return Recording(columns, step_s, text(lines(columns, ",")))


def chamber_printer(rng: np.random.Generator) -> Recording:
    """Bed, hot end and heated chamber of a machine for high temperatures, in Polish without accents."""
    rows, step_s = 1700, 1.0
    made = printed(rng, rows, step_s, hot=(0, 380, 395, 385), bed=(0, 120, 130), chamber=(0, 70, 80))
    columns = [words("czas", "time", stamps(rows, step_s, "%Y-%m-%d %H:%M:%S"))]
    for k, device in enumerate(("dyszy", "stolu", "komory")):
        columns += [
            num(f"Temperatura {device} [C]", "output", made.run.temperature[k]),
            num(f"Temperatura zadana {device} [C]", "setpoint", made.run.target[k], 0),
            num(f"Moc grzalki {device} [%]", "input", made.run.duty[k], 0, scale=(1, 0)),
        ]
    columns += [
        num("Wentylator wydruku [%]", "disturbance", made.fan, 0, speed=True),
        num("Posuw filamentu [mm/s]", "disturbance", made.feed, 2, speed=True),
        num("Temperatura otoczenia [C]", "disturbance", made.room),
        num("Pozycja X [mm]", "ignore", 100 + 80 * np.sin(0.7 * np.arange(rows)), 2),
        num("Pozycja Z [mm]", "ignore", 0.2 + 0.2 * (np.arange(rows) // 60), 2),
        num("Licznik warstw", "ignore", np.arange(rows) // 60, 0),
    ]
    return Recording(columns, step_s, text(lines(columns, ";"), end="\r\n"))


# a bare capture has no names: to say which table or log to save instead is an answer too
CAPTURE = r"(?i)octoprint|serial\.log|(save|write|convert|turn).*\bCSV\b"
HEADERS = [
    Header("siemens", "Siemens TIA, German", "Trace_DB10.csv", siemens),
    Header("beckhoff", "Beckhoff TwinCAT Scope", "ExtruderScope.txt", beckhoff),
    Header("b_and_r", "B&R mapp", "mappTrend.csv", b_and_r),
    Header("allen_bradley", "Allen-Bradley RSTrendX, Portuguese", "Zonas.csv", allen_bradley),
    Header("omron", "Omron CX-Supervisor, French, no accents", "DATALOG1.csv", omron),
    Header("eurotherm", "Eurotherm iTools", "EPC3000.csv", eurotherm),
    Header("gefran", "Gefran, Italian, accents", "registrazione.csv", gefran),
    Header("jumo", "Jumo recorder, Polish, accents, units in row 2", "LOGOSCREEN.csv", jumo),
    Header("yokogawa", "Yokogawa CENTUM, PV/SV/MV, units in row 2", "trend.csv", yokogawa),
    Header("omega", "Omega logger, Fahrenheit", "OMDAQ_0001.csv", omega),
    Header("krauss_maffei", "KraussMaffei, German, umlauts", "Protokoll.csv", krauss_maffei),
    Header("battenfeld", "Battenfeld, German, no units", "BEX.csv", battenfeld),
    Header("reifenhaeuser", "Reifenhäuser, German, Latin-1", "Linie3.csv", reifenhaeuser),
    Header("leistritz", "Leistritz lab extruder, Dutch", "proef12.txt", leistritz),
    Header("reprap", "RepRapFirmware object model", "duet.csv", reprap),
    Header("marlin", "Marlin M155 capture", "capture.log", marlin, CAPTURE),
    Header("octoprint", "OctoPrint plugin CSV", "temps.csv", octoprint),
    Header("klipper", "CSV made of klippy.log", "klippy.csv", klipper),
    Header("prusa", "Prusa Buddy metrics", "metrics.csv", prusa),
    Header("bambu", "Bambu-like MQTT reports", "report.csv", bambu),
    Header("labview", "LabVIEW measurement file, French, accents", "essai_003.lvm", labview),
    Header("matlab", "MATLAB writetable, y r u", "experiment.csv", matlab),
    Header("pandas_export", "pandas with index, TIC101.PV/SP/OP", "history.csv", pandas_export),
    Header("arduino", "Arduino serial log", "serial.txt", arduino),
    Header("ros", "ROS bag as CSV", "bag.csv", ros),
    Header("influx", "InfluxDB annotated CSV, Portuguese", "query.csv", influx),
    Header("home_assistant", "Home Assistant, wide", "history_wide.csv", home_assistant),
    Header("excel", "Excel with sep=;, Spanish, accents", "ensayo.csv", excel),
    Header("syringe", "Stand for a heated syringe", "stand.csv", syringe),
    Header("chamber_printer", "Bed, hot end and chamber, Polish", "drukarka.csv", chamber_printer),
]
