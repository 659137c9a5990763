"""Hot ends and the controllers that are exported for them: PI by SIMC of the hot end's own linear model, and
what makes up for fan and filament, 20 % short as one of a record may be."""

import numpy as np
import scipy.linalg

from pipeline.deploy.assembly import supervision
from pipeline.deploy.machine import plants_sha256
from pipeline.deploy.supervise import Exported, Machine, Signal
from pipeline.temperature.controllers import baseline
from pipeline.temperature.controllers.law import FeedForward, deployed
from pipeline.temperature.plant import Plant, plant
from tests.deploy.deployed_machines import guard, limits_of
from tests.foreign.hot_end import KELVIN, Parts

TARGET_DEGC, SAMPLE_S, NOISE_DEGC = 210.0, 1.0, 0.1
FILAMENT_J_PER_MM = 1.5  # what a mm of filament takes away
SHORT = 0.8  # of the gain that would make up for all of it
HOT_ENDS = [
    Parts(power_W=power, thermistor_s=lag, block_J_per_K=block, fan=fan)
    for power, lag, block, fan in [
        (25.0, 2.0, 10.0, 0.15),
        (30.0, 5.0, 15.0, 0.3),
        (35.0, 1.0, 12.0, 0.3),
        (40.0, 3.0, 15.0, 0.5),
        (50.0, 4.0, 20.0, 0.5),
        (60.0, 1.5, 18.0, 0.7),
    ]
]


def model(parts: Parts) -> Plant:
    """The hot end about TARGET_DEGC: cartridge, block and thermistor, duty in percent."""
    above, k = TARGET_DEGC - parts.room_degC, parts.cartridge_to_block_W_per_K
    slope = 1.25 * parts.convection_W * above**0.25 + parts.cold_end_W_per_K
    slope += 4 * parts.radiation_W_per_K4 * (TARGET_DEGC + KELVIN) ** 3
    lost = parts.convection_W * above**1.25 + parts.cold_end_W_per_K * (TARGET_DEGC - parts.cold_end_degC)
    lost += parts.radiation_W_per_K4 * ((TARGET_DEGC + KELVIN) ** 4 - (parts.room_degC + KELVIN) ** 4)
    A = np.zeros((4, 4))
    A[0] = np.array([-k, k, 0.0, parts.power_W / 100]) / parts.cartridge_J_per_K
    A[1] = np.array([k, -(k + slope), 0.0, 0.0]) / parts.block_J_per_K
    A[2] = np.array([0.0, 1.0, -1.0, 0.0]) / parts.thermistor_s
    moved = scipy.linalg.expm(SAMPLE_S * A)
    return plant(
        moved[:3, :3],
        moved[:3, 3:],
        [[0.0, 0.0, 1.0]],
        d=[TARGET_DEGC - lost / slope],
        K=np.full((3, 1), 0.1),
        sample_time_s=SAMPLE_S,
    )


def exported(parts: Parts, *, told: bool = True) -> Exported:
    """PI by SIMC; `told` part fan and filament."""
    made, limits = model(parts), limits_of(1)
    law = baseline.pi_law(baseline.pairing(made, limits.low, limits.high, horizon=300), inputs=1)
    blown = parts.convection_W * parts.fan * (TARGET_DEGC - parts.room_degC) ** 1.25
    gain = SHORT * np.array([[blown, 100 * FILAMENT_J_PER_MM]]) / parts.power_W
    # a kick fades by half each sample, and so adds twice its lead: the time constant of the cartridge
    lead = parts.cartridge_J_per_K / parts.cartridge_to_block_W_per_K / SAMPLE_S / 2
    disturbances = (Signal("part_fan", "percent", -np.inf, np.inf), Signal("feed", "mm/s", -np.inf, np.inf))
    machine = Machine(
        (Signal("heater", "percent", 0.0, 100.0),),
        (Signal("thermistor", "degC", 0.0, 285.0),),
        SAMPLE_S,
        disturbances if told else (),
    )
    return Exported(
        name="pi",
        machine=machine,
        controller=deployed(
            law,
            limits,
            integral_limit=1.0,
            governor=guard(made, limits, 285.0),
            forward=FeedForward(gain, np.zeros(2), np.full(2, lead)) if told else None,
        ),
        model=made,
        fallback=None,
        supervision=supervision(made, machine, np.full(1, NOISE_DEGC)),
        simulated=False,
        plant_sha256=plants_sha256([made]),
        spread_sha256=plants_sha256([]),
    )
