"""The words of the pages, each explained once, as a process engineer would."""

from pipeline.report.shared.sources import Sources
from pipeline.temperature.controllers.table import CONTROLLERS as CONTESTANTS
from pipeline.verdict.digits import THIN

INDEX = (
    "verdict",
    "columns",
    "pair",
    "quantile",
    "passed",
    "settled",
    "peak",
    "settling",
    "heating",
    "overshoot",
    "at_limits",
    "margin_disk",
    "margin_delay",
    "crossings",
    "false_stops",
    "spread",
    "data",
    "drift",
    "accepted",
    "hash",
    "basis",
    "recorded_windows",
    "sticky",
    "settles",
    "stays",
)
# key of an answer -> the word that explains it
ANSWERS = {
    "settled_error": "settled",
    "peak": "peak",
    "settling": "settling",
    "heating": "heating",
    "overshoot": "overshoot",
    "at_limits": "at_limits",
    "disk": "margin_disk",
    "delay_s": "margin_delay",
    "crossings": "crossings",
    "supervisor": "false_stops",
    "cost": "cost",
    "data": "data",
}


FIXED = {
    "quantile": (
        "90 % quantile",
        "Nine in ten of all cases (plants, starts, references, noise) are better than this figure. Its "
        "band says where it would lie for other plants of the same spread.",
    ),
    "pair": (
        "The pair",
        "The model-based controller against the data-driven one, tuned with the same budget and cost, on "
        "the same plants: a paired test over plants. Each kind is represented by the controller that cost "
        "least on the training plants. A difference counts only if it is larger than its standard "
        "deviation over structures of machines; then the same controller would win on four in five "
        "machines of another structure. The percentage is that of the typical ratio of their costs "
        "(geometric mean, every case counts alike); the 90 % quantiles of the table are those of the "
        "costly cases.",
    ),
    "crossings": (
        "Crossings",
        "Cases in which a true output leaves the range between low and high of plant.outputs.",
    ),
    "false_stops": (
        "False stops",
        "Each controller runs with its supervisor on four healthy machines, through set-point changes, a "
        "door, a fan and another room. This counts the runs in which the supervisor stops the control "
        "law.",
    ),
    "cost": (
        "Cost as deployed",
        "The declared engineering cost of a run, with limits, integrator, hand-over and noise, as the "
        "controller runs on a machine. Every controller was tuned for it.",
    ),
    "passed": (
        "Passed",
        "The whole band lies inside the limit. Failed: the whole band lies beyond the limit. Undecided: "
        "the band includes the limit; this does not pass.",
    ),
    "margin_disk": (
        "Disk margin",
        "How much gain and phase may change, in all channels at once, before the loop oscillates; a "
        "margin of 0.4 allows gains from 2/3 to 3/2.",
    ),
    "margin_delay": (
        "Delay margin",
        "How much extra delay of all sensors, in seconds, the loop tolerates before it oscillates.",
    ),
    "verdict": (
        "Verdict",
        "Pass, fail or undecided (simulation): judged on simulated machines, no claim about a real one. "
        "Undecided: no rule failed, but a rule is undecided or not measured. Ready for a supervised trial: "
        "judged on models of the recorded machine; somebody stays at it throughout.",
    ),
    "columns": (
        "Data\u2011driven, model\u2011based",
        "Temperature: the learned kernel or predictive control; a controller of an identified model. "
        "Deposition: basis functions of a chain identified "
        + "from trials; the paper’s law and its library; on\u2011off control. Setpoint: the paper’s "
        "agent; a Bayes filter.",
    ),
    "settling": (
        "Settling",
        "How long it takes until every zone has come within the band around its reference and "
        "stays there for good.",
    ),
    "peak": (
        "Largest error once settled",
        "How far the worst zone is from its reference at most, once the controller has settled. A loop "
        "that swings around its reference can have a mean error of zero.",
    ),
    "heating": (
        "Settling from cold",
        "The same from the coldest start. Its limit is the settling limit plus the shortest time in which "
        "full inputs take the identified plant there.",
    ),
    "overshoot": ("Overshoot", "The furthest way that any zone goes past its reference."),
    "drift": (
        "Drift",
        "How far the machine has moved away from the record that its controller was learned from. "
        "Only a machine in use can show it.",
    ),
    "hash": (
        "Hash",
        "The first digits of a fingerprint (SHA-256) of a file: equal hashes, equal bytes. "
        "The foot of each page has all of them; ./run dvc status checks the files.",
    ),
    "accepted": ("Accepted run", "The last run that a person marked as good with ./run beadline accept."),
    "at_limits": (
        "Time at limits",
        "Share of all commands that are beyond what the machine can give. A controller’s commands are "
        "clipped; “hold” keeps the inputs of the start, even below 0 if only that holds the start.",
    ),
    "trusted": (
        "Trusted",
        "To simulate: the rules simulation and stability. To predict: the rule ahead. To design "
        "controllers: ahead, inputs used up, excitation, effects known, stability, and, if inputs are "
        "declared to heat, no gain whose whole band is impossible. If the whiteness test fails, a better "
        "observer exists; this is a warning only.",
    ),
    "fit": (
        "Fit",
        "100 % less the size of the error as a share of the size of the output’s movement about its mean. "
        "100 % is perfect, 0 % is the mean, " + "below 0 % is worse than the mean.",
    ),
    "simulation": (
        "Simulation",
        "The model runs from the inputs alone and never sees an output; only where it starts is fitted.",
    ),
    "ahead": (
        "Ahead",
        "The model predicts so far ahead from all outputs until then, and from the inputs throughout.",
    ),
    "held": ("Held", "The last output, repeated for that long. Any prediction must be better."),
    "free_mean": (
        "Free mean",
        "The same simulation, shifted by the mean of its error. What the shift gains is the cost of "
        "another ambient or operating point.",
    ),
    "closed_loop": (
        "Closed loop",
        "A controller set the inputs from the outputs while the record was taken. Granger’s test shows it: "
        "inputs follow past errors of the outputs.",
    ),
    "feedthrough": (
        "Feed-through",
        "The output answers an input within the same sample: the row of D is not zero.",
    ),
    "first_order": (
        "First order and delay",
        "K e^(−θs) / (τs + 1): the steady rise by one per cent of the input, the time constant, "
        "the dead time.",
    ),
    "simc": (
        "SIMC",
        "Skogestad’s rules from gain, time constant and dead time to a PID: the closed loop as fast as the "
        "dead time, a third of it as derivative time.",
    ),
    "holdout": (
        "Hold-out",
        "The last part of every stretch of the record. Order, window and model are chosen without it.",
    ),
    "fit_band": (
        "Band of a fit",
        "90 of 100 hold-outs of this length would lie in this band (blocks of the hold-out are "
        "resampled). A fit whose band includes its limit is undecided.",
    ),
    "whiteness": (
        "Whiteness",
        "The one-step prediction errors are noise: none predicts the next one. Ljung and Box’s test at 99 %.",
    ),
    "inputs_left": (
        "Inputs used up",
        "No error follows an input: what inputs do, the model explains. At 99 %, over all lags.",
    ),
    "excitation": (
        "Excitation",
        "In how many directions the inputs moved over the window: "
        "a direction without movement teaches nothing.",
    ),
    "identified_spread": (
        "Spread",
        "Plants identified again from records with resampled errors, also of one order higher: they "
        "differ as much as the record allows. Bands of step responses also cover what fits without one "
        "quarter of the record give.",
    ),
    "on_off": (
        "On\u2011off control",
        "Wanted flow divided by the known gain: what a machine does if nobody knows how slow it is. Its "
        "error is 100 %.",
    ),
    "pressure_advance": (
        "Pressure advance",
        "The controller of Klipper, Marlin and slicers: the wanted flow and pressure advance times its "
        "change, smoothed. It is tuned on the identified chain, so it costs no print. With a lead, all of it "
        "is sent ahead, which no firmware does.",
    ),
    "basis": (
        "Basis functions",
        "Our composer: the command for any part is built from a few functions of the wanted flow, "
        "fitted to the trials through an identified chain. It needs no trained task.",
    ),
    "stream": ("Stream", "What one tool prints of one part, in its material."),
    "library": (
        "Library",
        "The paper’s composer: signals learned once for Start, Stop, Corner and Steady\u2011State, laid one "
        "after another as the part program asks.",
    ),
    "priority": (
        "Priority rule",
        "Where two signals of the library overlap, one is dropped: Stop before Start before Corner before "
        "Steady\u2011State before No\u2011Flow.",
    ),
    "superposition": (
        "Superposition",
        "Where two signals overlap, both are added, as deviations from the steady command.",
    ),
    "whole": (
        "Learned whole",
        "Trials of this very part by our law: the best that learning gives. Signals composed without such "
        "trials are compared with it.",
    ),
    "forecast": (
        "Forecast",
        "The 90 % interval of the result before anything is printed: of the chains that the trials cannot "
        "distinguish, widened by their errors on routines that they were not fitted to. Not judged: the "
        "trials do not determine it; the reason and the trial that would help stand beside it. True "
        "figures come from a simulated machine that nothing was fitted to.",
    ),
    "lead": (
        "Lead",
        "How long before its event a signal must begin, because the material responds late. In a line "
        "shorter than the lead there is no time for the Stop signal.",
    ),
    "trial": (
        "Trial",
        "One run of the training routine: off, on, a pause of the gantry that simulates a corner, on, "
        "off. Trial 0 is on\u2011off control.",
    ),
    "through_pictures": (
        "Through pictures",
        "The law does not get the true flow. It gets the flow measured from camera frames of the bead, "
        "trial by trial, as on a machine.",
    ),
    "gamma": (
        "γ",
        "By how much, at most, the error of one trial can be larger than that of the trial before, "
        "over all frequencies. Below 1 learning converges.",
    ),
    "saturation": (
        "Saturation",
        "The command asks for more than the drive can give and is clipped. No law makes up for it; longer "
        "ramps do.",
    ),
    "line_volume": (
        "Line volume",
        "Material between the middles of the gaps before and after a printed line, "
        "against bead area times length.",
    ),
    "window_of_frames": (
        "Window",
        "Twenty frames in a row, on which one decision rests. They are of one segment and repeat each other: "
        "their evidence is worth about two frames.",
    ),
    "settles": (
        "Settle",
        "Flow within 90–110 % and nozzle within 210 ± 5 °C from the 90th decision at the latest until the "
        "100th. The true flow counts; no controller knows it.",
    ),
    "stays": ("Stay", "Settled, and inside from then on until decision 200."),
    "recovers": (
        "Recover",
        "At decision 60 the nozzle clogs to 60 % of its flow. Recovered: inside again from decision 90 at "
        "the latest until decision 120.",
    ),
    "agent": (
        "Agent",
        "A network that learned in simulation what to change. It learns from rewards and gets no model of "
        "the machine (deep Q-learning).",
    ),
    "as_published": (
        "As published",
        "The paper’s own agent: its network, four phases and settings, trained as the paper says. Values "
        "that the paper does not publish are in params.expert.yaml or in the notes.",
    ),
    "bayes": (
        "Bayes filter",
        "Keeps a probability for each flow, corrects it with every window by how often such windows occur "
        "at that flow, and moves towards 100 %.",
    ),
    "sequential": (
        "Sequential test",
        "Adds up the evidence of windows until it suffices for a move, then begins anew.",
    ),
    "recorded_windows": (
        "Classified windows",
        "Windows that the trained classifier really classified, sampled again by the present flow. Its "
        "errors lie at the class borders and last for several decisions.",
    ),
    "segment": (
        "Segment",
        "A stretch of one print whose pictures share light, place and bead. Intervals resample whole "
        "segments.",
    ),
    "clog": (
        "Clog, half clog",
        "From the named decision on, less material comes out than the extruder feeds; the share that "
        "still flows stands beside the name. After a half clog more flows than after a clog.",
    ),
    "good_starts": (
        "Perfect, in band",
        "Prints without a fault: the flow begins at 100 %, or somewhere within the good band. Harm is "
        "what a controller spoils of them.",
    ),
    "faulty_camera": (
        "Stuck, blind, another camera, borders",
        "Stuck: the camera shows one picture again and again. Blind: it shows no line. Both last for the "
        "number of decisions that stands there. Another camera: not the one that was learned. Borders: "
        "its borders between the classes lie elsewhere.",
    ),
    "sticky": (
        "Sticky",
        "The conditions of a picture last for about ten decisions, so an error repeats. Fresh: each "
        "window is of another segment.",
    ),
    "accuracy": (
        "Accuracy",
        "Share of windows that the paper’s simulator classifies correctly; the others get one of the two "
        "other classes.",
    ),
    "worst_case": (
        "Worst case",
        "The case in which the fewest runs of a controller settle and stay. "
        "By default the simplest controller runs that does no harm and is within noise of the best "
        "worst case.",
    ),
    "interval": (
        "Interval",
        "The true share lies here with 95 % confidence, for the number of runs made: Wilson’s interval, "
        "or, if runs share segments of a print, resampled by segment. A share whose interval includes its "
        "limit is undecided.",
    ),
    "key_area": (
        "Key area",
        "The 48 × 16 pixels beside the nozzle that hold the line just printed, cut out along it.",
    ),
    "calibrated": (
        "Calibrated",
        "Of answers given with 80 % confidence, 80 % are right. The error is the mean distance between the "
        "two (expected calibration error).",
    ),
    "held_window": (
        "Held",
        "Nothing is sent: too few frames show a line, they are foreign, or the tip moved. If two classes "
        "remain possible, the window counts by its flow and may move the controller.",
    ),
    "foreign": (
        "Foreign",
        "A picture whose features are further from the training data than those of 95 % of familiar "
        "pictures (Mahalanobis distance).",
    ),
    "reward": (
        "Reward",
        "1 at 100 % and 210 °C, falling along tilted ellipses, because a hotter nozzle needs less flow. "
        "The semi-axes a, b say how fast.",
    ),
    "study": (
        "The study",
        "The published work that gives the method; “as published” repeats its own way of counting, digit "
        "by digit.",
    ),
} | {
    contestant.name: (contestant.word or contestant.heading, contestant.explanation)
    for contestant in CONTESTANTS
}


def glossary(sources: Sources) -> dict[str, tuple[str, str]]:
    """{key: (word, meaning)}; figures in a meaning are those of the parameters."""
    machine = sources.declared.machine
    allowed = sources.declared.everything.get("learn_kernel", {}).get("allowed_gap_percent")
    enough = (
        "little more than the best"
        if allowed is None
        else f"no more than {allowed:g}{THIN}% above the best (learn_kernel.allowed_gap_percent)"
    )
    spread = (
        "Plants within the uncertainty of the identified model, of another order than the model."
        if sources.recorded
        else "Plants that nothing was learned from or tuned on: gains, time constants, losses, "
        "delays and the "
        "room’s temperature vary, by one declared seed."
    )
    return FIXED | {
        "settled": (
            "Settled error",
            "How far the mean temperature of the last 100 steps lies from the reference, for the "
            "zone where it "
            "lies furthest; noise about that mean does not count.",
        ),
        "spread": ("Plant spread", spread),
        "data": (
            "Samples needed",
            f"So many that what its own estimator leaves open costs {enough}; for the learned kernel, no "
            "fewer than its unknowns.",
        ),
        "step": ("Step", f"One sample of the controller, {machine.sample_time_s:g} s here."),
    }


def chosen(sources: Sources, keys: tuple[str, ...]) -> list[tuple[str, str]]:
    meanings = glossary(sources)
    return [meanings[key] for key in keys]


# key of a figure -> the word as the page lists it; "Settled error" and "Samples needed" hang on the run
ANSWERS_WORDS = {
    key: {"settled": "Settled error", "data": "Samples needed"}.get(word, FIXED.get(word, ("",))[0])
    for key, word in ANSWERS.items()
}


def explaining(key: str) -> str:
    """The word that explains an answer; none where it explains itself."""
    return ANSWERS_WORDS.get(key, "")
