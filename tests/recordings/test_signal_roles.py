"""Headers as PLCs, controllers, printers and loggers of many vendors write them: what each column is taken
for. Each column is simulated as what it is: a zone under PI control, its set-point, its duty, a screw, a fan,
the room's air."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from pipeline.recordings.inspection import look
from pipeline.recordings.proposals import Proposal, propose, yaml_lines
from pipeline.recordings.signal_names import read_name
from pipeline.temperature.settings import Plant
from tests.mcap_writing import Written

# kind of a column -> its role in the proposal
ROLES = {
    "pv": "output",
    "sp": "set-point",
    "op": "input",
    "fan": "disturbance",
    "rpm": "disturbance",
    "room": "disturbance",
    "": "",
}
# vendor -> {column: kind and zone}
HEADERS = {
    "Siemens S7, German": (
        "Uhrzeit;Zone1_Soll:sp1;Zone1_Ist:pv1;Zone1_Stellgrad:op1;Zone2_Soll:sp2;Zone2_Ist:pv2;"
        "Zone2_Stellgrad:op2;Schneckendrehzahl:rpm;Massedruck:;Raumtemperatur:room"
    ),
    "Siemens TIA, German with units": (
        "Zeit;DB10.Düse.Temperatur Sollwert [°C]:sp1;DB10.Düse.Temperatur Istwert [°C]:pv1;"
        "DB10.Düse.Stellgröße [%]:op1;DB10.Zylinder 2.Temperatur Sollwert [°C]:sp2;"
        "DB10.Zylinder 2.Temperatur Istwert [°C]:pv2;DB10.Zylinder 2.Stellgröße [%]:op2;"
        "DB10.Lüfterdrehzahl [1/min]:rpm;DB10.Motorstrom [A]:"
    ),
    "Siemens PID_Temp": (
        "Time;PID_Temp_1.Setpoint:sp1;PID_Temp_1.ScaledInput:pv1;PID_Temp_1.OutputHeat:op1;"
        "PID_Temp_2.Setpoint:sp2;PID_Temp_2.ScaledInput:pv2;PID_Temp_2.OutputHeat:op2"
    ),
    "ISA tags": (
        "Time;TIC101/SP:sp1;TIC101/PV:pv1;TIC101/OP:op1;TIC102/SP:sp2;TIC102/PV:pv2;TIC102/OP:op2;"
        "SIC201/SP:sp;SIC201/PV:rpm;PI301/PV:;TI401 Ambient:room"
    ),
    "Beckhoff": (
        "Time;MAIN.aZone[1].fActualTemp:pv1;MAIN.aZone[1].fSetTemp:sp1;MAIN.aZone[1].fYOut:op1;"
        "MAIN.aZone[2].fActualTemp:pv2;MAIN.aZone[2].fSetTemp:sp2;MAIN.aZone[2].fYOut:op2;"
        "MAIN.fScrewSpeed:rpm"
    ),
    "B&R": (
        "Time;gHeat[0].ActTemp:pv1;gHeat[0].SetTemp:sp1;gHeat[0].Out:op1;gHeat[1].ActTemp:pv2;"
        "gHeat[1].SetTemp:sp2;gHeat[1].Out:op2;gDrive.ActSpeed:rpm;gDrive.SetSpeed:sp"
    ),
    "Allen-Bradley": (
        "Date Time;Zone1_PID.PV:pv1;Zone1_PID.SP:sp1;Zone1_PID.CV:op1;Zone2_PID.PV:pv2;Zone2_PID.SP:sp2;"
        "Zone2_PID.CV:op2;Extruder_RPM:rpm;Ambient_Temp_F:room"
    ),
    "Eurotherm": (
        "Time;Loop1.PV:pv1;Loop1.WSP:sp1;Loop1.WOP:op1;Loop2.PV:pv2;Loop2.WorkingSP:sp2;Loop2.ActiveOut:op2;"
        "Loop1.Deviation:"
    ),
    "Gefran, Italian": (
        "Tempo;Valore impostato zona 1 (°C):sp1;Valore reale zona 1 (°C):pv1;Potenza zona 1 (%):op1;"
        "Valore impostato zona 2 (°C):sp2;Valore reale zona 2 (°C):pv2;Potenza zona 2 (%):op2;"
        "Velocità vite (giri/min):rpm;Temperatura ambiente (°C):room"
    ),
    "KraussMaffei": (
        "Zeit;ZylHz1Ist:pv1;ZylHz1Soll:sp1;ZylHz1Stellwert:op1;ZylHz2Ist:pv2;ZylHz2Soll:sp2;"
        "ZylHz2Stellwert:op2;Schneckendrehz. Ist:rpm;Einspritzdruck:;Zykluszeit:"
    ),
    "French": (
        "Temps;T_consigne_1:sp1;T_mesure_1:pv1;Puissance chauffage 1 (%):op1;T_consigne_2:sp2;T_mesure_2:pv2;"
        "Puissance chauffage 2 (%):op2;Vitesse vis:rpm;Température ambiante:room"
    ),
    "Spanish": (
        "Tiempo;Consigna zona 1:sp1;Medida zona 1:pv1;Calefactor 1 (%):op1;Consigna zona 2:sp2;"
        "Medida zona 2:pv2;"
        "Calefactor 2 (%):op2;Velocidad husillo:rpm;Ventilador (%):fan"
    ),
    "German without umlauts": (
        "Zeit;Tsoll1:sp1;Tist1:pv1;Heizleistung1:op1;Tsoll2:sp2;Tist2:pv2;Heizleistung2:op2;"
        "Luefter:fan;Foerderband:rpm;Umgebungstemp:room"
    ),
    "controllers of Asia": (
        "Time;CH1 PV:pv1;CH1 SV:sp1;CH1 MV:op1;CH2 PV:pv2;CH2 SV:sp2;CH2 MV:op2;CH1 ALM:;Fan Speed:fan"
    ),
    "OctoPrint": (
        "timestamp;tool0 actual:pv1;tool0 target:sp1;tool0 power:op1;bed actual:pv2;bed target:sp2;"
        "bed power:op2;fan speed:fan"
    ),
    "Duet": (
        "Time;heat.heaters[0].current:pv2;heat.heaters[0].active:sp2;heat.heaters[0].avgPwm:op2;"
        "heat.heaters[1].current:pv1;heat.heaters[1].active:sp1;heat.heaters[1].avgPwm:op1;"
        "fans[0].actualValue:fan;boards[0].mcuTemp.current:"
    ),
    "Marlin": "time_s;T:pv1;T_target:sp1;@:op1;B:pv2;B_target:sp2;B@:op2;fan_pwm:fan",
    "LabVIEW": (
        "X_Value;Temperature Zone 1 (Deg C):pv1;Setpoint Zone 1 (Deg C):sp1;Heater 1 (%):op1;"
        "Temperature Zone 2 (Deg C):pv2;Setpoint Zone 2 (Deg C):sp2;Heater 2 (%):op2;Screw Speed (RPM):rpm;"
        "Room (Deg C):room"
    ),
    "thermologger": (
        "Date/Time;101 <Zone 1> (C):pv1;102 <Zone 2> (C):pv2;103 <Ambient> (C):room;201 <Heater 1> (%):op1;"
        "202 <Heater 2> (%):op2"
    ),
    "Filabot": "Time;Temperature:pv1;Set Temp:sp1;Heater Duty:op1;Puller Speed:rpm;Filament Diameter:",
    "DIN 19226": "Zeit;Zone 1 w:sp1;Zone 1 x:pv1;Zone 1 y:op1;Zone 2 w:sp2;Zone 2 x:pv2;Zone 2 y:op2",
    "addresses of S7": (
        "Zeit;DB20.DBD4 Zone 1 Ist:pv1;DB20.DBD8 Zone 1 Soll:sp1;DB20.DBD12 Zone 1 Stellgrad:op1;"
        "DB20.DBD16 Zone 2 Ist:pv2;DB20.DBD20 Zone 2 Soll:sp2;DB20.DBD24 Zone 2 Stellgrad:op2"
    ),
    "CODESYS over OPC": (
        "Time;|var|CODESYS.Application.GVL.rTempIst_1:pv1;|var|CODESYS.Application.GVL.rTempSoll_1:sp1;"
        "|var|CODESYS.Application.GVL.rStellgrad_1:op1;|var|CODESYS.Application.GVL.rTempIst_2:pv2;"
        "|var|CODESYS.Application.GVL.rTempSoll_2:sp2;|var|CODESYS.Application.GVL.rStellgrad_2:op2;"
        "|var|CODESYS.Application.GVL.rDrehzahl:rpm"
    ),
    "German, a die and a feed zone": (
        "Zeit;Kopf_Ist:pv1;Kopf_Soll:sp1;Kopf_Stellgrad:op1;Einzug_Ist:pv2;Einzug_Soll:sp2;"
        "Einzug_Stellgrad:op2;Foerderrate:rpm"
    ),
    "short names": (
        "Time;Tset:sp1;Tact:pv1;Pout:op1;E_speed:rpm;speed_factor:;Chamber Temp:room;Part Fan:fan"
    ),
    "a drive among PIDs": (
        "Time;PID1_PV:pv1;PID1_SP:sp1;PID1_OUT:op1;PID2_PV:pv2;PID2_SP:sp2;PID2_OUT:op2;VFD_Freq_Hz:rpm;"
        "VFD_Cmd:rpm"
    ),
    "a laboratory's printer": (
        "Time (s);Nozzle T (C):pv1;Nozzle T demand (C):sp1;Nozzle heater duty (0-1):op1;Bed T (C):pv2;"
        "Bed T demand (C):sp2;Bed heater duty (0-1):op2;Plunger speed (mm/s):rpm;Lab T (C):room"
    ),
    "feedback and set": (
        "Time;Heater1_Fbk:pv1;Heater1_Set:sp1;Heater1_Out:op1;Heater2_Fbk:pv2;Heater2_Set:sp2;"
        "Heater2_Out:op2;Motor1_Fbk:rpm;Motor1_Set:sp;Motor1_Out:rpm"
    ),
    "German, water and haul-off": (
        "Zeit;Düse_Ist:pv1;Düse_Soll:sp1;Düse_Y:op1;Zone3_Ist:pv2;Zone3_Soll:sp2;Zone3_Y:op2;"
        "Dosierschnecke_n:rpm;Kühlwasser_T:room;Abzug:rpm;Lüfter_%:fan"
    ),
    "Italian with units": (
        "Time;Temperatura Zona 1 [°C]:pv1;SetPoint Zona 1 [°C]:sp1;Uscita Zona 1 [%]:op1;"
        "Temperatura Zona 2 [°C]:pv2;SetPoint Zona 2 [°C]:sp2;Uscita Zona 2 [%]:op2;Giri Vite [rpm]:rpm;"
        "Ventola [%]:fan;Pressione Massa [bar]:;Assorbimento Motore [A]:"
    ),
    "French with units": (
        "Time;Consigne zone 1 (°C):sp1;Mesure zone 1 (°C):pv1;Sortie zone 1 (%):op1;"
        "Consigne zone 2 (°C):sp2;Mesure zone 2 (°C):pv2;Sortie zone 2 (%):op2;Régime vis (tr/min):rpm;"
        "Consigne vis (tr/min):sp;Température atelier (°C):room;Ventilateur (%):fan"
    ),
    "PT100 and SSR": ("Time;PT100_1:pv1;PT100_2:pv2;SSR_1:op1;SSR_2:op2;SET_1:sp1;SET_2:sp2;Tamb:room"),
    "an unknown word for the set-point": (
        "Time;Lämpötila 1 asetus [°C]:sp1;Lämpötila 1 [°C]:pv1;Lämmitys 1 [%]:op1;"
        "Lämpötila 2 asetus [°C]:sp2;"
        "Lämpötila 2 [°C]:pv2;Lämmitys 2 [%]:op2"
    ),
}


def columns_of(header: str) -> tuple[str, dict[str, str]]:
    """The time's name, and {column: kind and zone}."""
    time, *columns = header.split(";")
    return time, dict(column.rsplit(":", 1) for column in columns)


def simulated() -> dict[str, np.ndarray]:
    """Two zones under PI control, by kind and zone, with what acts on them."""
    rng, n = np.random.default_rng(3), 900
    table = {}
    for zone, gain, tau in (("1", 4.0, 60.0), ("2", 3.0, 90.0)):
        wanted = np.repeat([180.0, 205.0, 190.0], n // 3) - (30 if zone == "2" else 0)
        temperature, duty, integral, y = np.zeros(n), np.zeros(n), 0.0, 24.0
        for k in range(n):
            temperature[k] = y + rng.normal(0, 0.1)
            error = wanted[k] - temperature[k]
            duty[k] = np.clip(0.8 * error + integral, 0, 100)
            integral += 0.01 * error if 0 < duty[k] < 100 else 0.0
            y += (24 + gain * duty[k] - y) / tau
        table |= {f"sp{zone}": wanted, f"pv{zone}": temperature, f"op{zone}": duty}
    table["rpm"] = 40 + 5.0 * (np.arange(n) // 200) + rng.normal(0, 0.2, n)
    table["fan"] = np.repeat([0.0, 40.0, 100.0], n // 3)
    table["room"] = 23 + np.sin(np.arange(n) / 150) + rng.normal(0, 0.05, n)
    table["sp"], table[""] = np.repeat([40.0, 45.0, 50.0], n // 3), 30 + rng.normal(0, 1, n)
    return table


def record(path: Path, header: str) -> Path:
    time, kinds = columns_of(header)
    table = simulated()
    rows = np.column_stack([np.arange(900.0), *(table[kind] for kind in kinds.values())])
    delimiter = ";"
    path.write_text(
        "\n".join(
            [
                delimiter.join([time, *kinds]),
                *(delimiter.join(f"{value:.3f}" for value in row) for row in rows),
            ]
        ),
        encoding="utf-8",
    )
    return path


def proposal_of(path: Path) -> Proposal:
    recording = look(path)
    return propose(recording.signals, recording.groups, recording.time)


@pytest.mark.parametrize("header", HEADERS.values(), ids=HEADERS.keys())
def test_the_columns_of_a_vendor_are_taken_for_what_they_are(tmp_path, header):
    proposal = proposal_of(record(tmp_path / "machine.csv", header))
    roles = {signal.source: signal.role for signal in proposal.signals}
    roles |= {signal.set_point: "set-point" for signal in proposal.signals if signal.set_point}
    roles |= dict.fromkeys(proposal.set_points, "set-point")
    _, kinds = columns_of(header)
    wrong = {
        name: roles.get(name, "")
        for name, kind in kinds.items()
        if roles.get(name, "") != ROLES[kind.rstrip("12")]
    }
    assert wrong == {}


@pytest.mark.parametrize("header", HEADERS.values(), ids=HEADERS.keys())
def test_each_output_has_the_set_point_of_its_own_zone_and_a_number_of_its_own(tmp_path, header):
    proposal = proposal_of(record(tmp_path / "machine.csv", header))
    _, kinds = columns_of(header)
    for signal in proposal.signals:
        if signal.role != "output":
            continue
        wanted = f"sp{kinds[signal.source][-1]}"
        assert kinds.get(signal.set_point, "") == (wanted if wanted in kinds.values() else "")
        assert not signal.set_point or signal.reference == pytest.approx(
            180 if wanted == "sp1" else 150, abs=26
        )


@pytest.mark.parametrize("header", HEADERS.values(), ids=HEADERS.keys())
def test_the_proposal_of_a_vendors_file_is_a_plant_that_may_be_pasted(tmp_path, header):
    proposed = yaml.safe_load("\n".join(yaml_lines(proposal_of(record(tmp_path / "machine.csv", header)))))
    machine = Plant.model_validate_json(json.dumps(proposed["plant"]))
    assert {signal.name for signal in [*machine.acting, *machine.outputs]} == set(
        proposed["ingest"]["mapping"]
    )


def test_an_array_of_a_topic_has_the_topics_name_and_counts_from_one(tmp_path):
    made, table = Written(), simulated()
    topics = {
        "/extruder/zone_temperature": ("pv1", "pv2"),
        "/extruder/zone_setpoint": ("sp1", "sp2"),
        "/extruder/heater_duty": ("op1", "op2"),
        "/extruder/screw_rpm": ("rpm",),
    }
    channels = {topic: made.topic(topic, "json") for topic in topics}
    for k in range(900):
        for topic, kinds in topics.items():
            made.message(channels[topic], float(k), {"data": [float(table[kind][k]) for kind in kinds]})
    (tmp_path / "rig.mcap").write_bytes(made.bytes())
    proposal = proposal_of(tmp_path / "rig.mcap")
    named = {signal.name: (signal.source, signal.role, signal.set_point) for signal in proposal.signals}
    assert named == {
        **{
            f"zone_temperature_{i + 1}": (
                f"/extruder/zone_temperature:data[{i}]",
                "output",
                f"/extruder/zone_setpoint:data[{i}]",
            )
            for i in range(2)
        },
        **{f"heater_duty_{i + 1}": (f"/extruder/heater_duty:data[{i}]", "input", "") for i in range(2)},
        "screw_rpm_1": ("/extruder/screw_rpm:data[0]", "disturbance", ""),
    }


@pytest.mark.parametrize(
    ("name", "words", "kind"),
    [
        ("Düsentemperatur Ist [°C]", "duesentemperatur ist", "degC"),
        ("T1_C", "t 1", "degC"),
        ("TIst_1", "t ist 1", ""),
        ("rZoneTempSoll", "r zone temp soll", ""),
        ("Drehzahl 1/min", "drehzahl", "speed"),
        ("Vitesse (tr/min)", "vitesse", "speed"),
        ("Heater1%", "heater 1", "percent"),
        ("aZone[1].fY", "a zone 1 f y", ""),
        ("Feuchte [% r.F.]", "feuchte", "other"),
    ],
)
def test_a_name_is_split_at_signs_digits_and_capitals_and_its_unit_is_taken_off(name, words, kind):
    assert read_name(name)[:2] == (words, kind)


def test_a_screw_a_fan_and_the_room_are_disturbances_and_are_asked_about(tmp_path):
    path = record(tmp_path / "machine.csv", HEADERS["Siemens TIA, German with units"])
    lines = yaml_lines(proposal_of(path))
    assert '    - {name: db_10_luefterdrehzahl, unit: "1/min"}' in lines
    assert any("set_point: " in line and "Sollwert" in line for line in lines)
