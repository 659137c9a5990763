/* ---- the supervisor */

/* Kinds of cause, in the order of beadline_reason */
enum { SENSOR_OPEN, SENSOR_STILL, SENSOR_DEAF, HEATER_STUCK_ON, HEATER_WEAK, REFERENCE_OUT_OF_REACH, KINDS };
enum { MODE_LAW, MODE_OWN, MODE_OFF };

/* Why readings miss a forecast: faults of a heater, then what is no fault */
enum { LACKS, GIVES, HEAT, GROWS, LATE, DIFFERS, SHIFTS, EXPLANATIONS };

/* A forecast that no reading corrects, and what readings missed of it (supervisor.Kept) */
typedef struct {
    double state[2][WATCH], given[WATCH][INPUTS], unit[WATCH][INPUTS]; /* responses to inputs and one percent */
    double before[PAIRS], grown[PAIRS], began[OUTPUTS], first[OUTPUTS], least[OUTPUTS], most[OUTPUTS], total[2][OUTPUTS];
    double square[PAIRS], causes[PAIRS][EXPLANATIONS], cross[WINDOWS][PAIRS][EXPLANATIONS];
    int age, away[OUTPUTS];
} forecast_window;

/* All that the supervisor remembers (supervisor.Kept) */
typedef struct {
    double since[KINDS][SIGNALS], last[KINDS][SIGNALS], amount[KINDS][SIGNALS];
    double x[WATCH], e[OUTPUTS], slow[OUTPUTS], expected[OUTPUTS];
    double y[OUTPUTS], quantum[OUTPUTS], cleared_s[OUTPUTS], returned_s[OUTPUTS];
    forecast_window window[WINDOWS];
    double asked[INPUTS], usual[INPUTS], stirred[INPUTS], forward[INPUTS], clock_s[2];
    int repeats[OUTPUTS], bad[OUTPUTS], returns[OUTPUTS], shown[2][INPUTS], missing[INPUTS];
    int samples, mode, clocked, insane, active; /* active: causes that are there */
} supervisor_kept;
