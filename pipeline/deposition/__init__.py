"""Loop 2, deposition: trials of a plunger extruder -> the command that lays a line as wide as it should be.

Source: Hoelzle, Alleyne, Wagoner Johnson 2009. Commands u (T,) are in mm of the plunger, flows y and r (T,)
in mm³/s, T samples.

>>> import numpy as np
>>> from pipeline import deposition

The routine: 4 s off, 6 s on, a pause, 6 s on, off. The wanted flow r is bead area times speed.

>>> lengths = {"off_s": 4.0, "on_s": 6.0, "pause_s": 0.6, "tail_s": 8.0, "ramp_s": 0.15}
>>> r = deposition.routine(**lengths, speed=8.0, bead_area_mm2=0.304, sample_time_s=0.02).r
>>> print(r.shape, "samples, at most", round(float(r.max()), 2), "mm³/s")
(1230,) samples, at most 2.43 mm³/s

The machine is slower than the nominal model and answers late.

>>> nominal = deposition.Extruder(gain=1.08, time_constant_s=2.7)
>>> machine = deposition.Extruder(gain=0.92, time_constant_s=3.2, delay_s=0.1)
>>> def print_trial(u):
...     y = deposition.flow(machine, u, sample_time_s=0.02)
...     return deposition.Trial(u, y, y)

Trial by trial the law of the paper corrects the command by the error: `u <- Q (u + L e)` (eq. 2).

>>> settings = deposition.HoelzleSettings(learning_gain=0.25, fast_zero_s=0.03, order=2, cutoff_hz=3.0)
>>> law = deposition.hoelzle_law(
...     r, nominal, deposition.zero_phase, settings, drive=deposition.UNLIMITED, sample_time_s=0.02
... )
>>> trials = deposition.learn(law, print_trial, r / nominal.gain, r, trials=10, rise=0.1)
>>> errors = [float(np.sqrt(np.mean((trial.truth - r) ** 2))) for trial in trials]
>>> print(f"r.m.s. error {errors[0]:.2f} mm³/s in trial 0, {errors[10]:.2f} in trial 10")
r.m.s. error 0.95 mm³/s in trial 0, 0.16 in trial 10

Before anything runs: learning converges if gamma < 1.

>>> f = np.linspace(0.0, 25.0, 500)
>>> Q = deposition.magnitude(f, order=2, cutoff_hz=3.0, sample_time_s=0.02) ** 2
>>> L = deposition.hoelzle_filter(f, nominal, settings, sample_time_s=0.02)
>>> P = deposition.frequency_response(machine, f, sample_time_s=0.02)
>>> print(round(float(deposition.gamma(Q, L, P[None])[0]), 2))
0.92

A part program becomes moves.

>>> program = deposition.parse("G1 X10 F600\\nG1 X20 E1")
>>> print(program.moves.length, "mm,", program.refusals)
[10. 10.] mm, []
"""

from pipeline import import_when_used

_PLACES = {
    "Extruder": "extruder:Extruder",
    "flow": "extruder:flow",
    "frequency_response": "extruder:frequency_response",
    "routine": "extruder:routine",
    "UNLIMITED": "drive:UNLIMITED",
    "Trial": "learning.ilc:Trial",
    "HoelzleSettings": "learning.ilc:HoelzleSettings",
    "hoelzle_filter": "learning.ilc:hoelzle_filter",
    "hoelzle_law": "learning.ilc:hoelzle_law",
    "InverseSettings": "learning.ilc:InverseSettings",
    "InverseLaw": "learning.ilc:InverseLaw",
    "magnitude": "learning.ilc:magnitude",
    "zero_phase": "learning.ilc:zero_phase",
    "gamma": "learning.ilc:gamma",
    "learn": "learning.ilc:learn",
    "parse": "toolpath.gcode:parse",
}
__all__ = list(_PLACES)
__getattr__ = import_when_used(__name__, _PLACES)
