"""The exported C on a board: it fits, and in single precision it does what it does in double, for days."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipeline.deploy import to_c
from pipeline.deploy.supervise import Exported
from pipeline.temperature.controllers.governor import OutputLimits, governor
from pipeline.temperature.test_set import panel
from tests.deploy.deployed_machines import NOISE, STRENGTH, exported
from tests.deploy.test_export import made, needs_cc, written

COMPILER = "arm-none-eabi-gcc"
needs_board = pytest.mark.skipif(
    shutil.which(COMPILER) is None, reason=f"no {COMPILER} on this machine; install gcc-arm-none-eabi"
)
BUILD = (COMPILER, *"-std=c99 -mcpu=cortex-m3 -mthumb -mfloat-abi=soft -Os -ffunction-sections".split())
SINGLE = ("-fdata-sections", "-DBEADLINE_SINGLE", "-Wdouble-promotion", "-Werror")
LINKED = ("--specs=nosys.specs", "--specs=nano.specs", "-Wl,--gc-sections", "-lm")
# bytes for the functions of compiler and newlib, which tell no frames
LIBRARY_STACK = 128

FIRMWARE = """
#include "controller.h"
static beadline_controller c;
static beadline_decision decision;
volatile real u[INPUTS], y[OUTPUTS], r[OUTPUTS], told[DISTURBANCES + 1];
int main(void) {
    beadline_machine machine = {BEADLINE_PLANT_SHA256, BEADLINE_INPUT_UNIT, BEADLINE_OUTPUT_UNIT,
                                BEADLINE_SAMPLE_TIME_S, INPUTS, OUTPUTS};
    volatile beadline_clock t = 0;
    int i;
    beadline_init(&c, &machine, 1);
    beadline_watch(&c, (real *)u, (real *)y, (real *)r);
    beadline_hand_over(&c, (real *)y);
    for (;;) {
        beadline_tell(&c, (real *)told);
        beadline_step(&c, (real *)y, (real *)r, t++, (real *)u, &decision);
        for (i = 0; i < INPUTS; i++)
            u[i] = decision.u[i];
    }
}
"""


def guarded(of: Exported) -> Exported:
    """A controller with the governor that it is deployed with: its plant in time, and a sample late."""
    p = of.model.p
    family = panel.padded([panel.delayed(of.model, late) for late in (False, True)])
    limits = OutputLimits(np.zeros(p), np.full(p, 250.0), np.full(p, 3 * NOISE), 0.05)
    watched = governor(family, of.controller.limits, limits, STRENGTH)
    fallback = of.fallback and of.fallback._replace(governor=watched)
    return of._replace(controller=of.controller._replace(governor=watched), fallback=fallback)


def deepest(graph: str) -> int:
    """Bytes of the deepest path of calls in a graph that -fcallgraph-info=su wrote. Raises RecursionError for
    a function that calls itself."""
    nodes = re.findall(r'node: \{ title: "([^"]+)" label: "([^"]*)"', graph)
    frames = {name: int((re.findall(r"(\d+) bytes", label) or [0])[0]) for name, label in nodes}
    calls = re.findall(r'sourcename: "([^"]+)" targetname: "([^"]+)"', graph)

    def under(name: str) -> int:
        return frames[name] + max((under(to) for at, to in calls if at == name), default=0)

    return max(map(under, frames))


def linked(folder: Path, of: Exported) -> tuple[int, int]:
    """Bytes of flash, and of memory with the stack, of a firmware that does nothing else."""
    for name, text in (to_c.code(of, "0" * 64) | {"firmware.c": FIRMWARE}).items():
        (folder / name).write_text(text)
    for name in ("controller", "firmware"):
        command = [*BUILD, *SINGLE, "-fcallgraph-info=su", "-c", f"{name}.c"]
        subprocess.run(command, cwd=folder, check=True)
    objects = ["controller.o", "firmware.o"]
    command = [*BUILD, *objects, *LINKED, "-o", "firmware.elf"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    told = subprocess.run(
        ["arm-none-eabi-size", "firmware.elf"], cwd=folder, capture_output=True, text=True, check=True
    )
    text, data, bss = map(int, told.stdout.splitlines()[1].split()[:3])
    stack = sum(deepest((folder / f"{name}.ci").read_text()) for name in ("controller", "firmware"))
    return text + data, data + bss + stack + LIBRARY_STACK


@needs_board
@pytest.mark.parametrize(("kind", "flash", "memory"), [("pi", 32_768, 4_096), ("study", 131_072, 32_768)])
def test_a_controller_with_supervisor_and_limiter_fits_a_cortex_m3(kind, flash, memory, tmp_path):
    """PI of one heater, and the five zones of the study."""
    found = linked(tmp_path, guarded(exported(kind, zones=1)))
    assert found[0] <= flash and found[1] <= memory


@needs_cc
@pytest.mark.parametrize("kind", ["pi", "window", "told", "tight", "study"])
def test_single_precision_asks_for_what_the_object_asked_for(kind, tmp_path):
    """And no number is a double by mistake. The clock wraps round on the way."""
    done = made(written(tmp_path, exported(kind)), "single")
    assert done.returncode == 0, done.stdout + done.stderr


DAYS = """
#include "controller.h"
#include <stdio.h>
#include "test_plant.h"
#ifdef BEADLINE_SINGLE
#define AT(t_s) ((beadline_clock)(uint64_t)(1e3 * (t_s) + 0.5))
#define SECONDS_OF(clock) (1e-3 * (double)(clock))
#else
#define AT(t_s) (t_s)
#define SECONDS_OF(clock) (clock)
#endif
#define UPTIME_S (49 * 86400.0) /* milliseconds wrap round 17 hours later */
#define SAMPLES 1000000
#define BREAKS 950000

int main(void) {
    static beadline_controller c;
    static beadline_decision d;
    beadline_machine machine = {BEADLINE_PLANT_SHA256, "percent", "degC", BEADLINE_SAMPLE_TIME_S, 1, 1};
    beadline_clock since;
    unsigned long random = 1;
    double x[STATES], after[STATES], u = 40, temperature, mean = 0;
    long t;
    int i, j, late = 0;
    for (i = 0; i < STATES; i++)
        x[i] = 0;
    beadline_init(&c, &machine, 1);
    for (t = 0; t < SAMPLES && late < 60; t++) {
        double t_s = UPTIME_S + BEADLINE_SAMPLE_TIME_S * (double)t;
        real y, r = t / 100000 % 2 ? 210 : 200, manual = 40;
        random = (1103515245 * random + 12345) % 2147483648u;
        for (j = 0, temperature = plant_d[0]; j < STATES; j++)
            temperature += plant_C[0][j] * x[j];
        y = (real)(temperature + 0.2 * ((double)random / 2147483648.0 - 0.5));
        mean += temperature / 50000;
        if (t < 50)
            beadline_watch(&c, &manual, &y, &r);
        else
            beadline_step(&c, &y, &r, AT(t_s), 0, &d);
        u = t < 50 ? 40 : (double)d.u[0];
        late += t > BREAKS && d.mode;
        if (t % 50000 == 49999) {
            printf("%.6f %d\\n", mean, t < 50 ? 0 : d.mode);
            mean = 0;
        }
        for (i = 0; i < STATES; i++) {
            after[i] = plant_b[i] + plant_B[i][0] * (t < BREAKS ? u : 0);
            for (j = 0; j < STATES; j++)
                after[i] += plant_A[i][j] * x[j];
        }
        for (i = 0; i < STATES; i++)
            x[i] = after[i];
    }
    since = AT(UPTIME_S + BEADLINE_SAMPLE_TIME_S * (double)t) - d.cause[0].since;
    printf("%ld %d %.4f\\n", t, d.cause[0].kind, SECONDS_OF(since));
    return 0;
}
"""


@needs_cc
def test_single_precision_reads_and_writes_nothing_that_is_not_its_own(tmp_path):
    folder = written(tmp_path, exported("pi"), episodes=3)
    built = made(folder, "sanitized", "STRICT=-std=c99 -DBEADLINE_SINGLE")
    if built.returncode and "cannot find" in built.stderr:
        pytest.skip("the compiler has no sanitizers")
    assert built.returncode == 0, built.stderr
    done = subprocess.run(["./sanitized", "golden.csv"], cwd=folder, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@needs_cc
def test_single_precision_keeps_its_clock_and_its_sums_for_days(tmp_path):
    """Three and a half days of samples every 0.3 s, and a heater that breaks at their end: both precisions
    heat alike to 0.001 °C in the mean and find the fault at the same sample. 18 s later they say since when,
    equal to the millisecond."""
    of = exported("pi", zones=1, sample_time_s=0.3)
    for name, text in (to_c.code(of, "0" * 64) | {"days.c": DAYS}).items():
        (tmp_path / name).write_text(text)
    done = []
    for flag in ("-DBEADLINE_DOUBLE", "-DBEADLINE_SINGLE"):
        command = ["cc", "-std=c99", "-O2", flag, "-o", "days", "days.c", "controller.c", "-lm"]
        subprocess.run(command, cwd=tmp_path, check=True)
        told = subprocess.run(["./days"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
        done.append(np.array([list(map(float, line.split())) for line in told.splitlines()[:-1]]))
        done.append(np.array(told.splitlines()[-1].split(), float))
    means, found, single_means, single_found = done
    assert len(means) == 19 and not means[:, 1].any() and not single_means[:, 1].any()
    assert np.abs(means[:, 0] - single_means[:, 0]).max() < 1e-3
    assert 950_000 < found[0] < 1_000_000 and np.array_equal(found[:2], single_found[:2])
    assert abs(found[2] - single_found[2]) <= 1e-3
