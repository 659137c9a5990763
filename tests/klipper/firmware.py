"""A firmware's own host program (Klipper or Kalico) in virtual time, with our micro-controller and hot end.

    python -S firmware.py < scenario.json

runs apart from the tests: `path` of the scenario is the whole of sys.path. Everything of klippy is its own:
configuration, heaters, PID, verify_heater, gcode, toolhead, status, SAVE_CONFIG and restarts. Ours are the
clock, which jumps to the next timer, and the pins: the heater, the fans and the analog input of a simulated
hot end. A pin that is not set again within its longest duration shuts the printer down, as theirs does.

A step of the scenario is the name of a method of Run and what it is given: ["gcode", text], ["wait", s],
["feed", mm/s, s], ["print", file], ["status", objects]. Its answer and the printer's state after it come
back. Filament takes `feed_J_per_mm` of the scenario away from the hot end, as it moves.
"""

import importlib
import json
import logging
import os
import sys
import time
import traceback

SCENARIO = json.load(sys.stdin)
sys.path[:] = SCENARIO["path"]

import greenlet  # noqa: E402
import numpy as np  # noqa: E402
from hot_end import HotEnd, Parts  # noqa: E402

for name in SCENARIO["without"]:
    sys.modules[name] = None  # as if it were not installed

TRACE_S = 0.3
FULL_SCALE_DEGC = 500.0  # of the analog input: [adc_temperature linear] of the configuration
E_LINE_MM = 5.0
WALL_S = 1.8e9  # of the wall clock, when the firmware's own clock is at 0


def klippy(name):
    """A module of the tree: in a package or, as upstream, beside the program."""
    return importlib.import_module(f"klippy.{name}" if SCENARIO["package"] else name)


class Machine(HotEnd):
    """The hot end on the firmware's clock: duty and fan of the pins, and filament that takes heat away."""

    def __init__(self, parts, seed):
        super().__init__(np.random.default_rng(seed), parts)
        self.at_s, self.duty, self.fan, self.taken_J = None, 0.0, 0.0, 0.0

    def fail(self, what):
        """A sensor that is slow, loose in its hole or stuck, or a heater that is dead, from now on."""
        changed = {"slow": ("thermistor_s", 20 * self.parts.thermistor_s), "dead": ("power_W", 0.0)}
        if what in changed:
            self.parts = self.parts._replace(**dict([changed[what]]))
        elif what == "stuck":
            last = self.read()
            self.read = lambda: last
        else:
            read, room = self.read, self.parts.room_degC
            self.read = lambda: room + 0.6 * (read() - room)

    def until(self, now_s):
        self.at_s = now_s if self.at_s is None else self.at_s
        count = int((now_s - self.at_s + 0.001) / 0.05)
        for _ in range(count):
            self.advance(100 * self.duty, 100 * self.fan, 0.05)
            self.block -= self.taken_J / count / self.parts.block_J_per_K
            self.at_s += 0.05
        if count:
            self.taken_J = 0.0


class Pwm:
    """An output pin: what was scheduled comes true at its time."""

    def __init__(self, mcu, name):
        self.mcu, self.name, self.planned, self.value, self.set_s = mcu, name, [], 0.0, 0.0
        self.longest_s = 0.0

    def get_mcu(self):
        return self.mcu

    def setup_max_duration(self, seconds):
        self.longest_s = seconds

    def setup_cycle_time(self, *_):
        pass

    setup_start_value = setup_cycle_time

    def next_aligned_print_time(self, print_time, *_):
        return print_time

    def set_pwm(self, print_time, value, *_):
        self.planned.append((print_time, value))

    def set_digital(self, print_time, value):
        self.set_pwm(print_time, float(value))

    def at(self, now_s):
        while self.planned and self.planned[0][0] <= now_s:
            self.set_s, self.value = self.planned.pop(0)
        if self.value and self.longest_s and now_s - self.set_s > self.longest_s:
            self.mcu.printer.invoke_shutdown("Missed scheduling of next digital out event")
        return 0.0 if self.mcu.printer.is_shutdown() else self.value


class Adc:
    """The analog input of the thermistor."""

    def __init__(self, mcu):
        self.mcu, self.last = mcu, (0.0, 0.0)

    def get_mcu(self):
        return self.mcu

    def setup_minmax(self, *_, minval=0.0, maxval=1.0, **__):
        self.range = minval, maxval

    def setup_adc_sample(self, report_s, *_, **limits):
        self.setup_minmax(**limits)

    def setup_adc_callback(self, *given):
        *report_s, self.callback = given
        # Klipper of 2026 is given a list of reports
        self.report_s, self.lists = (report_s or [0.3])[0], not report_s
        reactor = self.mcu.printer.get_reactor()
        reactor.register_timer(self._report, reactor.monotonic() + 0.7)

    def get_last_value(self):
        return self.last

    def _report(self, now_s):
        self.mcu.advance(now_s)
        value = self.mcu.machine.read() / FULL_SCALE_DEGC
        low, high = self.range
        self.last = value, now_s
        if not low <= value <= high:
            self.mcu.printer.invoke_shutdown("ADC out of range")
        self.callback(*([[(now_s, value)]] if self.lists else [now_s, value]))
        return now_s + self.report_s


class Mcu:
    """Pins, and a clock that is the host's."""

    def __init__(self, printer, machine):
        self.printer, self.machine, self.pwm, self.flushed, self.fed_mm = printer, machine, {}, [], 0.0

    def setup_pin(self, kind, given):
        if kind == "adc":
            return Adc(self)
        return self.pwm.setdefault(given["pin"], Pwm(self, given["pin"]))

    def advance(self, now_s):
        for name, pin in self.pwm.items():
            if name in ("duty", "fan"):
                setattr(self.machine, name, pin.at(now_s))
        filament = self.filament(now_s)
        if filament > self.fed_mm:
            self.machine.taken_J += SCENARIO["feed_J_per_mm"] * (filament - self.fed_mm)
            self.fed_mm = filament
        self.machine.until(now_s)

    def filament(self, now_s):
        """The farthest that the extruder has pushed so far, in mm: what was pulled back is warm."""
        motion = self.printer.lookup_object("motion_report", None)
        queues = getattr(motion, "trapqs", None) or getattr(motion, "dtrapqs", {})
        position = queues["extruder"].get_trapq_position(now_s)[0] if "extruder" in queues else None
        return 0.0 if position is None else position[0]

    def estimated_print_time(self, eventtime):
        return eventtime

    def seconds_to_clock(self, seconds):
        return round(1e6 * seconds)

    def calibrate_clock(self, *_):
        return 0.0, 1e6

    def get_printer(self):
        return self.printer

    def get_name(self):
        return "mcu"

    def is_fileoutput(self):
        return False

    def min_schedule_time(self):
        return 0.1

    def max_nominal_duration(self):
        return 3.0

    def get_status(self, eventtime=None):
        return {}

    def stats(self, eventtime):
        return False, ""

    def register_flush_callback(self, callback):
        self.flushed.append(callback)

    def flush_moves(self, print_time, *_):
        for callback in self.flushed:
            callback(print_time, round(1e6 * print_time))

    def check_active(self, *_):
        """Nothing: the clock does not drift."""


def virtual_reactor():
    """klippy's reactor on a clock that jumps to the next timer."""

    class Reactor(klippy("reactor").SelectReactor):
        def __init__(self, start_s):
            super().__init__()
            self.now_s = start_s
            self.monotonic = lambda: self.now_s

        def _dispatch_loop(self):
            self._g_dispatch = greenlet.getcurrent()
            # `busy`, which Klipper of 2026 no longer asks for
            busy = [True] * (self._check_timers.__code__.co_argcount - 2)
            while self._process:
                self._check_timers(self.now_s, *busy)
                while not self._async_queue.empty():
                    self._got_pipe_signal(self.now_s)
                self.now_s = min(max(self.now_s + 1e-5, self._next_timer), self.now_s + 1.0)
            self._g_dispatch = None

    return Reactor


class Client:
    """A subscriber to the status, as Moonraker is one."""

    def __init__(self):
        self.last, self.count = {}, 0

    def is_closed(self):
        return False

    def send(self, data):
        self.last, self.count = data.get("params", data), self.count + 1


class Rollover:
    """Where klippy keeps what it writes again each day; with one it logs the settings."""

    def set_rollover_info(self, *_):
        """Nothing: a scenario is shorter than a day."""


class Run:
    """One scenario, over restarts."""

    def __init__(self):
        self.machine = Machine(Parts(**SCENARIO["parts"]), SCENARIO["seed"])
        self.steps, self.answers, self.states, self.trace = list(SCENARIO["steps"]), [], [], []
        self.said, self.printer, self.reactor, self.now_s = [], None, None, SCENARIO["start_s"]
        time.time = lambda: WALL_S + self.reactor.monotonic()

    def start(self):
        """A start of the program; what it ended with."""
        self.reactor = virtual_reactor()(self.now_s)
        klippy("mcu").add_printer_objects = self._add_mcu
        arguments = {"config_file": SCENARIO["config"], "start_reason": "startup", "software_version": "v0"}
        arguments |= {
            "gcode_fd": os.open(os.devnull, os.O_RDWR),
            "apiserver": None,
            "cpu_info": "",
            "log_file": None,
        }
        module = "printer" if SCENARIO["kalico"] else "klippy"
        self.printer = klippy(module).Printer(self.reactor, Rollover(), arguments)
        self.printer.lookup_object("gcode").register_output_handler(self.said.append)
        self.printer.register_event_handler("klippy:shutdown", self._shut_down)
        self.reactor.register_callback(self._traced)
        self.reactor.register_callback(self._play)
        ended = self.printer.run()
        self.now_s = self.reactor.monotonic() + 3.0
        self.machine.duty = self.machine.fan = self.machine.taken_J = 0.0
        self.reactor.finalize()
        return ended

    def _shut_down(self):
        """Steps that go on after a shutdown take no time; those that a crash cut off never end."""
        ends_s = self.reactor.monotonic() + 10.0
        self.reactor.register_callback(lambda eventtime: self.printer.request_exit("exit"), ends_s)

    def _add_mcu(self, config):
        printer = config.get_printer()
        self.mcu = Mcu(printer, self.machine)
        printer.add_object("mcu", self.mcu)
        printer.lookup_object("pins").register_chip("mcu", self.mcu)

    def _traced(self, now_s):
        while True:
            if heaters := self.printer.lookup_object("heaters", None):
                heater = next(iter(heaters.heaters.values()), None)
                if heater is not None:
                    self.mcu.advance(now_s)
                    row = (now_s, self.machine.block, heater.last_temp, heater.target_temp, self.machine.duty)
                    self.trace.append(row)
            now_s = self.reactor.pause(now_s + TRACE_S)

    def _play(self, now_s):
        self.reactor.pause(now_s + 2.0)
        self.client = Client()
        while self.steps:
            kind, *given = self.steps.pop(0)
            try:
                self.answers.append(getattr(self, f"_{kind}")(*given))
            except self.printer.command_error as error:
                self.answers.append(f"error: {error}")
            self.states.append(self.printer.get_state_message())
            if self.printer.run_result is not None:
                return
        self.printer.request_exit("exit")

    def _gcode(self, text):
        count = len(self.said)
        self.printer.lookup_object("gcode").run_script(text)
        return "\n".join(self.said[count:])

    def _wait(self, seconds):
        end_s = self.reactor.monotonic() + seconds
        while self.reactor.monotonic() < end_s and not self.printer.is_shutdown():
            self.reactor.pause(min(self.reactor.monotonic() + 1.0, end_s))

    def _feed(self, mm_per_s, seconds):
        gcode, end_s = self.printer.lookup_object("gcode"), self.reactor.monotonic() + seconds
        gcode.run_script("M83")
        while self.reactor.monotonic() < end_s and not self.printer.is_shutdown():
            gcode.run_script(f"G1 E{E_LINE_MM} F{60 * mm_per_s}")
            self.reactor.pause(self.reactor.monotonic() + 0.01)

    def _print(self, file):
        """Prints a file of the virtual SD card to its end."""
        self.printer.lookup_object("gcode").run_script(f"SDCARD_PRINT_FILE FILENAME={file}")
        card = self.printer.lookup_object("virtual_sdcard")
        while card.is_active() and not self.printer.is_shutdown():
            self.reactor.pause(self.reactor.monotonic() + 1.0)

    def _subscribe(self, objects):
        hooks, text = self.printer.lookup_object("webhooks"), {"objects": dict.fromkeys(objects)}
        request = json.dumps({"id": 1, "method": "objects/subscribe", "params": text}).encode()
        request = klippy("webhooks").WebRequest(self.client, request)
        hooks.get_callback("objects/subscribe")(request)
        return request.finish()

    def _status(self, objects):
        now_s = self.reactor.monotonic()
        found = {name: self.printer.lookup_object(name, None) for name in objects}
        return {name: one.get_status(now_s) for name, one in found.items() if one} | {
            "sent": self.client.count
        }

    def _break(self, how):
        """From now on the controller raises, or asks for a duty that is no number."""
        controller = self.printer.lookup_object("beadline").controller
        step = controller.step
        nan = np.array([np.nan])
        controller.step = None if how == "raises" else lambda *given: step(*given)._replace(u=nan)

    def _fail(self, what):
        self.machine.fail(what)

    def _listen(self):
        """From now on the controller's sample times and what it is told are kept, for `heard`."""
        controller = self.printer.lookup_object("beadline").controller
        step, self.times = controller.step, []
        tell, self.told = controller.tell, []
        controller.tell = lambda told: self.told.append(list(told)) or tell(told)
        controller.step = lambda y, r, t_s: self.times.append(t_s) or step(y, r, t_s)

    def _heard(self):
        return {"times": self.times, "told": self.told}

    def _pid(self):
        control = self.printer.lookup_object("heaters").lookup_heater("extruder").control
        control = getattr(control, "own", control)
        return [control.Kp * 255, control.Ki * 255, control.Kd * 255]


def main():
    log = open(SCENARIO["log"], "a", encoding="utf-8")  # noqa: SIM115
    logging.basicConfig(stream=log, level=logging.INFO, format="%(message)s")  # as klippy's own
    run, began = Run(), time.process_time()
    ended, starts = "", 0
    while starts == 0 or ended in ("restart", "firmware_restart"):
        ended, starts = run.start(), starts + 1
    json.dump(
        {
            "answers": run.answers,
            "states": run.states,
            "trace": run.trace,
            "said": run.said,
            "ended": ended,
            "starts": starts,
            "cpu_s": time.process_time() - began,
        },
        sys.stdout,
    )


if __name__ == "__main__":
    try:
        main()
    except Exception:
        traceback.print_exc()
        sys.exit(1)
