"""Klipper and Kalico: one heater under an exported controller, beadline_controller.py beside this file.

Copy both to klippy/extras/, and add to printer.cfg

    [beadline]
    heater: extruder
    plant: ...

It takes the place of the heater's PID once the printer is ready. Duty stays within max_power, verify_heater
watches on, and a target of 0 is off. Where the controller raises anything the heater's own control goes on
from the duty that there was, until the firmware is restarted. Written against klippy/extras/heaters.py
(Heater, ControlPID). Needs Python 3.10 and numpy, as input shaping does.
"""

import logging

from . import beadline_controller  # ty: ignore[missing-module-member] (exported beside this file)

PERCENT = 100.0
SETTLED_DEGC, SETTLED_DEGC_PER_S = 1.0, 0.1  # as PID_SETTLE_DELTA and PID_SETTLE_SLOPE
MULTIPLE = 0.02  # of a sample, by which it may miss a whole number of the sensor's reports


class Beadline:
    """Section [beadline]: the control of its heater, as ControlPID is one."""

    def __init__(self, config):
        self.printer = config.get_printer()
        self.heater_name = config.get("heater")
        plant, rehearsal = config.get("plant"), config.getboolean("rehearsal", False)
        try:
            self.controller = beadline_controller.controller(
                plant_sha256=plant,
                sample_time_s=beadline_controller.SAMPLE_TIME_S,
                input_unit=beadline_controller.INPUT_UNIT,
                output_unit=beadline_controller.OUTPUT_UNIT,
                rehearsal=rehearsal,
            )
        except ValueError as error:
            raise config.error(f"[beadline]: {error}") from error
        self.sample_time = beadline_controller.SAMPLE_TIME_S
        self.failed, self.mode, self.reason = False, "", ""
        self.next_time, self.duty, self.reference = None, 0.0, None
        self.drives, self.slope, self.last = False, 0.0, None
        self.printer.register_event_handler("klippy:connect", self.connected)

    def connected(self):
        """Takes the heater over. Raises the printer's config error where it is not the certified one."""
        heater = self.printer.lookup_object("heaters").lookup_heater(self.heater_name)
        signal = beadline_controller.EXPORTED.machine.inputs[0]
        report, power = heater.get_pwm_delay(), heater.get_max_power()
        reports = max(round(self.sample_time / report), 1)
        if abs(reports * report - self.sample_time) > MULTIPLE * self.sample_time:
            raise self.printer.config_error(
                f"[beadline]: the controller's sample time is {self.sample_time:g} s, which is no multiple "
                f"of the {report:g} s after which the sensor of {self.heater_name} reports; learn it from "
                "a recording at a multiple of these"
            )
        if abs(PERCENT * power - signal.high) > 1e-6 * PERCENT:
            raise self.printer.config_error(
                f"[beadline]: max_power of {self.heater_name} is {power:g} but the controller is certified "
                f"for {signal.high / PERCENT:g}; set max_power to that"
            )
        self.heater, self.report, self.max_power = heater, report, power
        self.own = heater.set_control(self)

    # ---- what Heater asks of its control

    def temperature_update(self, read_time, temp, target_temp):
        if self.failed:
            self.own.temperature_update(read_time, temp, target_temp)
            return
        self._sloped(read_time, temp)
        try:
            if self.next_time is None or read_time > self.next_time - 0.5 * self.report:
                self._sampled(read_time, temp, target_temp)
        # whatever it is: a heater is not left without control
        except Exception:
            logging.exception("beadline: %s goes back to its own control", self.heater_name)
            self._hand_back(read_time, temp, target_temp)
            return
        # a change below 5 % would wait: the law counts on what it asked for
        self.heater.next_pwm_time = 0.0
        self.heater.set_pwm(read_time, self.duty)

    def check_busy(self, eventtime, smoothed_temp, target_temp):
        if self.failed:
            return self.own.check_busy(eventtime, smoothed_temp, target_temp)
        return abs(target_temp - smoothed_temp) > SETTLED_DEGC or abs(self.slope) > SETTLED_DEGC_PER_S

    def get_type(self):
        return self.own.get_type() if self.failed else "beadline"

    def get_status(self, eventtime):
        return {"mode": "own control" if self.failed else self.mode, "reason": self.reason}

    # ---- a sample

    def _sampled(self, read_time, temp, target_temp):
        late = self.next_time is None or read_time > self.next_time + 0.5 * self.sample_time
        self.next_time = (read_time if late else self.next_time) + self.sample_time
        if target_temp <= 0.0:
            reference = temp if self.reference is None else self.reference
            self.controller.watch([0.0], [temp], [reference])
            self.drives, self.duty, self.mode, self.reason = False, 0.0, "watches", ""
            return
        if not self.drives:
            if self.reference is None:
                self.controller.watch([0.0], [temp], [target_temp])
            self.controller.hand_over([temp])
            self.drives = True
        self.reference = target_temp
        told = self.controller.step([temp], [target_temp], read_time)
        duty = float(told.u[0]) / PERCENT
        if not 0.0 <= duty <= 1.0:
            raise ValueError(f"the controller asks for a duty of {duty:g}, expected 0 to 1")
        self.duty = min(duty, self.max_power)
        if told.mode != self.mode:
            reason = told.causes[0].sentence if told.causes else ""
            logging.info("beadline: %s, mode %s. %s", self.heater_name, told.mode, reason)
            self.mode, self.reason = told.mode, reason

    def _sloped(self, read_time, temp):
        if self.last is not None and read_time > self.last[0]:
            passed = read_time - self.last[0]
            share = min(passed / self.heater.get_smooth_time(), 1.0)
            self.slope += share * ((temp - self.last[1]) / passed - self.slope)
        self.last = read_time, temp

    def _hand_back(self, read_time, temp, target_temp):
        """The heater's own control goes on: a PID from the duty that there was, without a kick of its
        derivative. Heater holds its lock here, so that set_control would wait for ever."""
        self.failed, own = True, self.own
        for name, value in (("prev_temp", temp), ("prev_temp_time", read_time - self.report)):
            if hasattr(own, name):
                setattr(own, name, value)
        if target_temp > 0.0 and getattr(own, "Ki", 0.0) > 0.0:
            total = (self.duty - own.Kp * (target_temp - temp)) / own.Ki
            for name in ("int_sum", "prev_temp_integ"):
                if hasattr(own, name):
                    setattr(own, name, total)
            if hasattr(own, "prev_err"):
                own.prev_err = target_temp - temp
        own.temperature_update(read_time, temp, target_temp)


def load_config(config):
    return Beadline(config)
