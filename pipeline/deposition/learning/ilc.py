"""Iterative learning control of the flow: the paper's law (Hoelzle 2009, eq. 2), the inverse of the
identified model averaged over trials, the convergence test before anything runs, the limits of the drive, and
the learning loop. The loop goes back to the best command after a bad trial, and restarts if the machine
changed."""

import functools
import math
import operator
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy.fft
import scipy.ndimage
import scipy.signal

from pipeline.deposition import reachable
from pipeline.deposition.drive import Drive, at_limit, demand, follows, obeyed
from pipeline.deposition.extruder import Extruder, flow, frequency_response
from pipeline.deposition.learning.trial_filter import Repeating, repeating
from pipeline.deposition.learning.trial_model import SMOOTHED_HZ, TrialModel, identify_with_lag, lag_delay_s

# share of the steady gain squared; it only keeps the inverse finite where half a sample of delay makes a
# zero, far above any Q
EPSILON = 1e-9
# half of Q is kept where the inverse of the model's lag amplifies by this. There the lag of a machine of
# another order is off by a factor of 3 and a quarter of a turn (lags of 0.06 and 0.17 s, identified as 0.84
# Hz)
LAG_INVERSE = 10.0
# at no frequency does the learned command have more than this times the amplitude that the model alone would
# give; so a machine with a third of the model's response there can still be learned
MOST = 3.0
# a trial is judged by means over this many samples, and its measured flow is scaled by up to this share to
# the wanted one, because white noise and the scale of one picture do not repeat from trial to trial
MEAN_OF, SCALE = 10, 0.02
# the part of them that remains, as share of trial 0's error: a trial may be worse than the best by this much
NOISE = 0.01
# the law's share of the step from the best command grows by this factor on a new best; at LITTLE or less the
# best command is sent again, to detect a machine that drifts
GROWTH, LITTLE = 1.5, 0.25
# the trials before this one show the law the machine
FIRST_SHARED = 3
# a trial within this many standard deviations of the last ones, of this many, has not risen
SCATTER, SCATTER_TRIALS = 3.0, 10
# but beyond this many times the best error it has risen, however the last ones scatter, because a growing
# scatter would let the next one grow more
FAR = 3.0
# the ink is brought to its yield over this time before flow is wanted, and let down over it afterwards
YIELD_LEAD_S = 0.4


class Trial(NamedTuple):
    """One trial: command u (T,) in mm as the drive applied it; measured flow y (T,) in mm^3/s, NaN where it
    was not observable; true flow (T,) if simulated, else None."""

    u: np.ndarray
    y: np.ndarray
    truth: np.ndarray | None = None


Law = Callable[[Sequence[Trial]], np.ndarray]


class HoelzleSettings(NamedTuple):
    """Settings of Hoelzle's law: learning gain k_p, fast zero in s, order and cut-off (Hz) of Q."""

    learning_gain: float
    fast_zero_s: float
    order: int
    cutoff_hz: float


class InverseSettings(NamedTuple):
    """Settings of the model inverse: the trials that identify the model, the least weight of a new trial,
    order and cut-off (Hz) of Q."""

    identify_trials: int
    floor: float
    order: int
    cutoff_hz: float


# ---- Q


@functools.cache
def _butterworth(order: int, cutoff_hz: float, sample_time_s: float) -> np.ndarray:
    if not 0 < cutoff_hz < 0.5 / sample_time_s:
        raise ValueError(
            f"Q filter: expected a cut-off between 0 and half the sampling rate, {0.5 / sample_time_s:g} Hz, "
            f"but found {cutoff_hz:g} Hz; lower the cut-off or sample faster"
        )
    return scipy.signal.butter(order, cutoff_hz, fs=1 / sample_time_s, output="sos")


def zero_phase(x: np.ndarray, *, order: int, cutoff_hz: float, sample_time_s: float) -> np.ndarray:
    """Runs the Butterworth low-pass of `order` forward and backward over x (..., T) and returns Q x (..., T),
    which is |Q|^2 without phase. x counts as zero before and after, because there is no flow then."""
    sos, pad = _butterworth(order, cutoff_hz, sample_time_s), round(order / cutoff_hz / sample_time_s)
    padded = np.zeros((*x.shape[:-1], x.shape[-1] + 2 * pad))
    padded[..., pad : padded.shape[-1] - pad] = x
    return scipy.signal.sosfilt(sos, scipy.signal.sosfilt(sos, padded)[..., ::-1])[..., ::-1][
        ..., pad : padded.shape[-1] - pad
    ]


def magnitude(frequency_hz: np.ndarray, *, order: int, cutoff_hz: float, sample_time_s: float) -> np.ndarray:
    """Returns |Q(f)| (F,) of one run of the Butterworth filter. Its square is the response of
    `zero_phase`."""
    sos = _butterworth(order, cutoff_hz, sample_time_s)
    return np.abs(scipy.signal.sosfreqz(sos, frequency_hz, fs=1 / sample_time_s)[1])


# ---- L


def _slow_inverse(
    model: Extruder, settings: HoelzleSettings, sample_time_s: float
) -> tuple[np.ndarray, np.ndarray]:
    scale = settings.learning_gain / model.gain
    return scipy.signal.bilinear(
        [scale * model.time_constant_s, scale], [settings.fast_zero_s, 1.0], 1 / sample_time_s
    )


def hoelzle_filter(
    frequency_hz: np.ndarray, model: Extruder, settings: HoelzleSettings, *, sample_time_s: float
) -> np.ndarray:
    """Returns L(f) = k_p / P̂ (F,), with P̂ = K (fast_zero s + 1) / (tau s + 1), by the bilinear transform
    (Hoelzle 2009, eq. 2). The fast zero makes the inverse proper."""
    return scipy.signal.freqz(
        *_slow_inverse(model, settings, sample_time_s), frequency_hz, fs=1 / sample_time_s
    )[1]


def hoelzle_law(
    r: np.ndarray,
    model: Extruder,
    q: Callable[..., np.ndarray],
    settings: HoelzleSettings,
    *,
    drive: Drive,
    sample_time_s: float,
) -> Law:
    """Returns the paper's law on the last trial (Hoelzle 2009, eq. 2). `q` is `zero_phase` or a function with
    the same arguments; `model` is the nominal model (1).

        u_{j+1} = Q (u_j + L e_j)

    u_j is the command that the drive applied, so nothing winds up at its limits. e_j = 0 where the flow was
    not observable.
    """
    b, a = _slow_inverse(model, settings, sample_time_s)

    def law(trials: Sequence[Trial]) -> np.ndarray:
        u, y, _ = trials[-1]
        e = np.where(np.isfinite(y), r - y, 0.0)
        following = q(
            u + scipy.signal.lfilter(b, a, e),
            order=settings.order,
            cutoff_hz=settings.cutoff_hz,
            sample_time_s=sample_time_s,
        )
        return obeyed(following, drive, sample_time_s=sample_time_s)

    return law


def inverse_filter(frequency_hz: np.ndarray, model: Extruder, *, sample_time_s: float) -> np.ndarray:
    """Returns L(f) = conj(H) / (|H|^2 + eps) (F,). H is the response of the identified model with its
    delay."""
    H = frequency_response(model, frequency_hz, sample_time_s=sample_time_s)
    return np.conj(H) / (np.abs(H) ** 2 + EPSILON * model.gain**2)


def inverse(x: np.ndarray, model: Extruder, *, sample_time_s: float) -> np.ndarray:
    """Returns L x (T,) by FFT. x is padded with zeros for the model's delay and one second more, so that
    nothing wraps around."""
    n = scipy.fft.next_fast_len(len(x) + round((model.delay_s + 1.0) / sample_time_s), real=True)
    f = np.fft.rfftfreq(n, sample_time_s)
    return np.fft.irfft(np.fft.rfft(x, n) * inverse_filter(f, model, sample_time_s=sample_time_s), n)[
        : len(x)
    ]


def known_share(frequency_hz: np.ndarray, model: Extruder) -> np.ndarray:
    """Returns T(f) (F,), the share of Q that is kept if the inverse of the model's lag amplifies.

        T(f) = 1 / (1 + (|lag(f)|^-4 - 1) / LAG_INVERSE^4),   |lag(f)|^2 = 1 / (1 + (f / lag_hz)^4)

    T is one half where the inverse amplifies by LAG_INVERSE, and 1 for a model without a lag. A lag of a few
    Hz is hardly identified beyond its own frequency, and may stand for lags of another order. Its inverse
    would amplify noise without limit, and learning would diverge where |Q (1 - L P)| > 1.
    """
    return 1 / (1 + ((1 + (frequency_hz / model.lag_hz) ** 4) ** 2 - 1) / LAG_INVERSE**4)


def known(x: np.ndarray, model: Extruder, *, sample_time_s: float) -> np.ndarray:
    """Returns T x (..., T) without phase (`known_share`)."""
    if math.isinf(model.lag_hz):
        return x
    n = scipy.fft.next_fast_len(x.shape[-1] + round(1 / sample_time_s), real=True)
    share = known_share(np.fft.rfftfreq(n, sample_time_s), model)
    return np.fft.irfft(share * np.fft.rfft(x, n), n)[..., : x.shape[-1]]


def bounded(x: np.ndarray, learned: np.ndarray, *, sample_time_s: float) -> np.ndarray:
    """Returns `learned` (T,), limited at each frequency to MOST times the amplitude of x (T,). Both
    amplitudes are summed over SMOOTHED_HZ around that frequency. If `learned` exceeds the limit at no
    frequency, it is unchanged.

    So no command grows without limit on any machine, because |u| <= MOST |L Q x|, and L Q is known.
    """
    n = scipy.fft.next_fast_len(len(x) + round(1 / sample_time_s), real=True)
    spectra = np.fft.rfft([x, learned], n)
    near = np.ones(max(round(SMOOTHED_HZ * n * sample_time_s), 1))
    # summed one by one, because a running sum loses small values next to the lowest frequencies
    asked, given = (np.sqrt(np.convolve(np.abs(one) ** 2, near, "same")) for one in spectra)
    kept = np.minimum(MOST * asked, given) / np.maximum(given, np.finfo(float).tiny)
    return np.fft.irfft(spectra[1] * kept, n)[: len(x)]


def wanted(r: np.ndarray, yield_: float, *, sample_time_s: float) -> np.ndarray:
    """Returns x (T,) in mm^3/s that gives the flow r: r + yield while flow is wanted. x rises to the yield
    just before and falls just after. r and yield are in mm^3/s."""
    half = round(YIELD_LEAD_S / sample_time_s)
    near = np.convolve(r > 0, np.ones(2 * half + 1), "full")[half : half + len(r)] / (half + 1)
    return r + yield_ * np.where(r > 0, 1.0, np.minimum(near, 1.0))


def command(
    x: np.ndarray, r: np.ndarray, model: Extruder, *, drive: Drive, sample_time_s: float
) -> np.ndarray:
    """Returns u (T,) in mm for which the model gives x (T,). If the drive cannot follow it, returns the u
    with the nearest flow (`reachable.nearest`)."""
    u = inverse(x, model, sample_time_s=sample_time_s)
    if follows(u, drive, sample_time_s=sample_time_s):
        return u
    a = math.exp(-sample_time_s / model.time_constant_s)
    scale, t = model.gain * (1 - a), np.arange(len(x)) * sample_time_s
    # u(t) shows in the flow one sample and the delay later; what is reached at a limit is slow, and a lag
    # makes that late
    later = t + sample_time_s + model.delay_s + lag_delay_s(model.lag_hz)
    free = np.interp(later, t, r) <= 0
    v = reachable.nearest(
        np.interp(later, t, x),
        free,
        pole=a,
        bound=scale * drive.amplitude_mm,
        step=scale * drive.speed_mm_per_s * sample_time_s,
    )
    u = np.diff(v, prepend=0.0) / scale + np.concatenate([[0.0], v[:-1]]) / model.gain
    return obeyed(u, drive, sample_time_s=sample_time_s)


class InverseLaw:
    """The law by model inverse over the trials i <= j that it gets. L is the inverse of the model identified
    from the first of them; the law remembers that model.

        u_{j+1} = Q sum_i w_i (u_i + L e_i)
                = L Q ((r + yield) / g - d)

    In the second line d is the average of what the model misses. Both lines are equal if the gain g of the
    next trial is 1; for one trial both are Q (u + L e). The weights w_i average what does not repeat, and
    follow what changes (`trial_filter.repeating`). Q is outside the sum, so falling weights do not let it
    erode the command, and |1 - k + k Q (1 - L P)| < 1 wherever |Q (1 - L P)| < 1, for any k. Q ends earlier
    if the model's lag would have to be inverted far above its frequency (`known_share`). The learned command
    is limited by the command that the model alone would give (`bounded`).

    `identify_trials` trials are identified together. After the on-off trial 0, the first learned commands
    show the extruder as it will be driven.
    """

    def __init__(self, r: np.ndarray, settings: InverseSettings, *, drive: Drive, sample_time_s: float):
        self.r, self.settings, self.drive, self.sample_time_s = r, settings, drive, sample_time_s
        self.q = {"order": settings.order, "cutoff_hz": settings.cutoff_hz, "sample_time_s": sample_time_s}
        self._first: list[Trial] = []
        self.model: TrialModel | None = None
        self.repeating: Repeating | None = None

    def __call__(self, trials: Sequence[Trial]) -> np.ndarray:
        model = self._identified(list(trials[: self.settings.identify_trials]))
        self.repeating = repeating(
            np.array([trial.u for trial in trials]),
            np.array([trial.y for trial in trials]),
            self.r,
            model,
            floor=self.settings.floor,
            smooth=lambda x: self._smooth(x, model.extruder),
            sample_time_s=self.sample_time_s,
        )
        d, gain, extruder = self.repeating.disturbance, self.repeating.gain, model.extruder
        x = self._smooth(wanted(self.r, extruder.yield_, sample_time_s=self.sample_time_s) / gain, extruder)
        x = bounded(x, x - self._smooth(d, extruder), sample_time_s=self.sample_time_s)
        return command(x, self.r, extruder, drive=self.drive, sample_time_s=self.sample_time_s)

    def _smooth(self, x: np.ndarray, model: Extruder) -> np.ndarray:
        """Returns T Q x (..., T): x below the law's cut-off, and only where the model's lag is known
        (`known_share`)."""
        return known(zero_phase(x, **self.q), model, sample_time_s=self.sample_time_s)

    def _identified(self, first: list[Trial]) -> TrialModel:
        """Returns the model of the trials `first`, identified once."""
        same = len(first) == len(self._first) and all(map(operator.is_, first, self._first))
        if self.model is None or not same:
            u, y = [trial.u for trial in first], [trial.y for trial in first]
            self._first = first
            self.model = identify_with_lag(u, y, sample_time_s=self.sample_time_s)
        return self.model


# ---- before anything runs


def gamma(Q: np.ndarray, L: np.ndarray, P: np.ndarray, delta: np.ndarray | float = 0.0) -> np.ndarray:
    """Returns the largest convergence factor over frequency f and all |Delta'(f)| <= delta(f).

        gamma = max |Q (1 - L P (1 + Delta'))| = max |Q| (|1 - L P| + |L P| delta)

    Below 1 the error shrinks monotonically, above 1 it grows in the end (Bristow, Tharayil and Alleyne 2006;
    with the multiplicative uncertainty delta, de Roover and Bosgra 2000).

    Q (F,) is |Q|^2 if Q runs both ways; L (F,); delta (F,); P (F,) or (plants, F) with the whole delay. The
    result is one number per plant.
    """
    return np.max(np.abs(Q) * (np.abs(1 - L * P) + np.abs(L * P) * delta), axis=-1)


class ActuatorHeadroom(NamedTuple):
    """The headroom of the drive. `peak` (mm) and `speed` (mm/s): of the command that r needs; `steady`: its
    steady command (mm); `ratio`: the least error as a share of trial 0's; `ramp_s`: the shortest ramp that
    the drive can follow."""

    peak: float
    steady: float
    ratio: float
    ramp_s: float
    speed: float


def actuator_headroom(
    r: np.ndarray,
    u0: np.ndarray,
    model: Extruder,
    *,
    order: int,
    cutoff_hz: float,
    drive: Drive,
    sample_time_s: float,
) -> ActuatorHeadroom:
    """Returns the headroom of the drive over the model for r (T,). The least error is that of the nearest
    flow that the drive can follow, as a share of the error with u0 (T,). The drive's backlash is left out,
    because it is learned.

    ramp_s is the longer of the solutions of (1 + tau / t_ramp) steady = amplitude and (1 + tau / t_ramp)
    steady / t_ramp = speed. It is infinite if the amplitude is not above the steady command.
    """
    x = zero_phase(
        wanted(r, model.yield_, sample_time_s=sample_time_s),
        order=order,
        cutoff_hz=cutoff_hz,
        sample_time_s=sample_time_s,
    )
    command_mm, speed = demand(inverse(x, model, sample_time_s=sample_time_s), sample_time_s=sample_time_s)
    steady = float((r.max() + model.yield_) / model.gain)
    best, first = (
        rms(r - flow(model, u, sample_time_s=sample_time_s))
        for u in (
            command(x, r, model, drive=drive, sample_time_s=sample_time_s),
            obeyed(u0, drive, sample_time_s=sample_time_s),
        )
    )
    ramp_s = max(_ramp_of_amplitude(drive, steady, model), _ramp_of_speed(drive, steady, model))
    return ActuatorHeadroom(command_mm, steady, best / first, ramp_s, speed)


def _ramp_of_amplitude(drive: Drive, steady: float, model: Extruder) -> float:
    """Returns the ramp in s whose peak command (1 + tau / ramp) steady is the amplitude; 0 without a
    limit."""
    over = drive.amplitude_mm / steady
    return model.time_constant_s / (over - 1) if over > 1 else math.inf


def _ramp_of_speed(drive: Drive, steady: float, model: Extruder) -> float:
    """Returns the ramp in s over which the command rises to (1 + tau / ramp) steady at the speed limit; 0
    without a limit."""
    rate = drive.speed_mm_per_s / steady
    if math.isinf(rate):
        return 0.0
    return (1 + math.sqrt(1 + 4 * model.time_constant_s * rate)) / (2 * rate)


def check_headroom(headroom: ActuatorHeadroom, *, drive: Drive, worst_ratio: float) -> None:
    """Raises ValueError if no law can bring the error below `worst_ratio` of trial 0's. The message names the
    ramp that would be enough."""
    if headroom.ratio <= worst_ratio:
        return
    needs = (
        f"these ramps need a peak command of {headroom.peak / headroom.steady:.1f} x steady "
        f"and the limit is {drive.amplitude_mm / headroom.steady:.1f} x"
    )
    if headroom.speed > drive.speed_mm_per_s:
        needs += f", and {headroom.speed:.0f} mm/s where the drive has {drive.speed_mm_per_s:g} mm/s"
    do = (
        f"ramps of {headroom.ramp_s:.2f} s would do"
        if math.isfinite(headroom.ramp_s)
        else "no ramp would do: print slower, or raise the limit above the steady command"
    )
    raise ValueError(
        f"actuator headroom: {needs}, so no law comes below {headroom.ratio:.0%} of the error of trial 0; "
        f"{do}"
    )


# ---- the learning loop


class NextCommand(NamedTuple):
    """The next command u (T,) in mm; `best`: the best trial of the machine as it is now; `rolled_back`:
    whether the last trial rose, so that u goes back to the best; `restarts`: the trials at which a change of
    the machine was found."""

    u: np.ndarray
    best: int
    rolled_back: bool
    restarts: list[int]


def rms(e: np.ndarray) -> float:
    """Returns the root mean square of the observable samples."""
    observable = e[np.isfinite(e)]
    return float(np.sqrt(observable @ observable / len(observable)))


def repeating_error(r: np.ndarray, y: np.ndarray) -> float:
    """Returns the r.m.s. of r - g y in mm^3/s, by means over MEAN_OF samples: the part of a trial's error
    that would repeat in the next trial. g is the scale within 1 +- SCALE that brings y nearest to r. r, y
    (T,), y NaN where not observable."""
    observable = np.isfinite(y)
    flow, target = np.where(observable, y, 0.0), np.where(observable, r, 0.0)
    scale = flow @ target / max(float(flow @ flow), np.finfo(float).tiny)
    e = target - np.clip(scale, 1 - SCALE, 1 + SCALE) * flow
    return rms(scipy.ndimage.uniform_filter1d(e, MEAN_OF)[observable])


class LearningState(NamedTuple):
    """The state of learning. `keep`: the trials to learn from, which are those of the machine as it is now
    without those that rose; `best`: the one of them with the least error; `risen`: whether each trial has
    risen; `restarts`: the first trial after each change of the machine; `repeat`: whether the next trial
    repeats the best command; `share`: if not, the share of the way from the best command to the law's;
    `drifts`: whether the machine drifts."""

    keep: list[int]
    best: int
    risen: list[bool]
    restarts: list[int]
    repeat: bool
    share: float
    drifts: bool


def judge(errors: Sequence[float], *, rise: float) -> LearningState:
    """Returns what the trials' errors so far show of machine and law. A trial has risen if its error exceeds
    the best by more than `rise` of trial 0's, and also exceeds the scatter of the trials before it or FAR
    times the best. A trial is worse if its error exceeds (1 + rise) times the best plus NOISE of trial 0's.

    The law sends again what the drive could not reach. So the next command goes only a share of the way from
    the best command to the law's. The share is halved after each worse trial and grows by GROWTH after a new
    best. After a rise, and after a worse trial with a share of LITTLE or less, the next trial repeats the
    best command, which shows whether the law or the machine is the cause. If the old error comes back, the
    law went too far or that trial was spoilt; a trial that rose is left out. If the repeat is worse, the
    machine drifts: worse trials no longer halve the share, and the law takes its whole step, or the halved
    one after a rise. If the repeat rises after a rise, the machine changed, and all trials before the first
    of the two are dropped.
    """
    keep, best, risen, restarts = [0], 0, [False], []
    repeat, share, drifts = False, 1.0, False
    for j in range(1, len(errors)):
        usual = _scattered([errors[i] for i in keep[2:]][-SCATTER_TRIALS:])
        risen.append(errors[j] > max(errors[best] + rise * errors[0], min(usual, FAR * errors[best])))
        worse, better = errors[j] > (1 + rise) * errors[best] + NOISE * errors[0], errors[j] < errors[best]
        if repeat and risen[j] and risen[j - 1]:
            restarts.append(j - 1)
            keep, best = [j - 1, j], min(j - 1, j, key=errors.__getitem__)
            repeat, share, drifts = False, 1.0, False
            continue
        if not risen[j]:
            keep.append(j)
            best = j if better else best
        if repeat and worse:
            repeat, share, drifts = risen[j], share if risen[j - 1] else 1.0, True
        elif repeat:
            repeat = False
        elif risen[j] or (worse and j >= FIRST_SHARED and not drifts):
            share /= 2
            repeat = risen[j] or share <= LITTLE
        elif drifts or better:
            share = min((2 if drifts else GROWTH) * share, 1.0)
    return LearningState(keep, best, risen, restarts, repeat, share, drifts)


def state_of(trials: Sequence[Trial], r: np.ndarray, *, rise: float) -> LearningState:
    """Returns the state (`judge`) after the trials on the wanted flow r (T,), by their repeating errors."""
    return judge([repeating_error(r, trial.y) for trial in trials], rise=rise)


def _scattered(errors: list[float]) -> float:
    """Returns the largest error that the scatter of these errors explains: their median plus SCATTER standard
    deviations; 0 for fewer than four. The deviation is computed from the changes between them, because these
    are small if an error creeps up."""
    if len(errors) < 4:
        return 0.0
    deviation = 1.4826 * float(np.median(np.abs(np.diff(errors)))) / math.sqrt(2)
    return float(np.median(errors)) + SCATTER * deviation


def next_step(trials: Sequence[Trial], r: np.ndarray, law: Law, *, rise: float) -> NextCommand:
    """Returns the next command after the trials so far. Nothing else is remembered, so a folder of recordings
    can be continued.

    After a trial that has risen (`judge`) the best command is repeated. If the machine changed, the law gets
    only the trials since then, so it identifies its model again. Otherwise it takes a share of its step from
    the best command. Raises ValueError if a trial has other shapes than r, or no observable flow.
    """
    for j, (u, y, _) in enumerate(trials):
        if u.shape != r.shape or y.shape != r.shape or not np.isfinite(y).any():
            raise ValueError(
                f"trial {j}: expected command and flow of {len(r)} samples, as the reference has, "
                f"some of it observable, but found {u.shape} and {y.shape} "
                f"with {np.isfinite(y).sum()} observable; leave the trial out or record it again"
            )
    state = state_of(trials, r, rise=rise)
    best = trials[state.best].u
    u = law([trials[i] for i in state.keep])
    if state.repeat:
        u = best
    elif state.share < 1:
        u = best + state.share * (u - best)
    return NextCommand(u, state.best, state.risen[-1], state.restarts)


def learn(
    law: Law,
    measure: Callable[[np.ndarray], Trial],
    u0: np.ndarray,
    r: np.ndarray,
    *,
    trials: int,
    rise: float,
    on_step: Callable[[Trial], None] = lambda trial: None,
) -> list[Trial]:
    """Runs trial 0 with u0 and then `trials` updates; returns all trials. `measure` runs one command on a
    plant."""
    done = [measure(u0)]
    on_step(done[0])
    while len(done) <= trials:
        done.append(measure(next_step(done, r, law, rise=rise).u))
        on_step(done[-1])
    return done


class TrialRow(NamedTuple):
    """One trial: errors in mm^3/s (the true one is NaN if nothing was simulated); `ratio` to trial 0, of the
    true error if known, else of the measured one."""

    trial: int
    rms_true: float
    rms_measured: float
    ratio: float
    peak_over_steady: float
    saturated: float
    rolled_back: bool


def table(
    trials: Sequence[Trial], r: np.ndarray, *, steady: float, drive: Drive, sample_time_s: float, rise: float
) -> list[TrialRow]:
    """Returns one row per trial. `steady` is the steady command in mm. In a row, `saturated` is the share of
    time at a limit of the drive, and `rolled_back` whether the trial was left for a better one."""
    measured = [rms(r - trial.y) for trial in trials]
    true = [np.nan if trial.truth is None else rms(r - trial.truth) for trial in trials]
    risen = state_of(trials, r, rise=rise).risen
    rows = []
    for j, (u, _, truth) in enumerate(trials):
        ratio = measured[j] / measured[0] if truth is None else true[j] / true[0]
        rows.append(
            TrialRow(
                j,
                true[j],
                measured[j],
                ratio,
                float(np.abs(u).max() / steady),
                float(np.mean(at_limit(u, drive, sample_time_s=sample_time_s))),
                risen[j],
            )
        )
    return rows
