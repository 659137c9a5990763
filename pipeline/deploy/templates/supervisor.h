/* ---- the supervisor */

/* Kinds of cause, in the order of beadline_reason */
enum { SENSOR_OPEN, SENSOR_STILL, SENSOR_DEAF, HEATER_STUCK_ON, HEATER_WEAK, REFERENCE_OUT_OF_REACH, KINDS };
enum { MODE_LAW, MODE_OWN, MODE_OFF };

/* Why readings miss a forecast: faults of a heater, then what is no fault */
enum { LACKS, GIVES, HEAT, LATE, DIFFERS, SHIFTS, EXPLANATIONS };

/* Signatures whose sums are kept: DIFFERS has that of LACKS, and GIVES that of LACKS and HEAT together */
enum { OF_LACKS, OF_HEAT, OF_LATE, OF_SHIFTS, SIGNATURES };

/* A forecast that no reading corrects, and what readings missed of it (supervise.Kept) */
typedef struct {
    real state[2][WATCH], given[WATCH][INPUTS], unit[WATCH][INPUTS]; /* responses to inputs and one percent */
    real before[PAIRS], began[OUTPUTS], first[OUTPUTS], least[OUTPUTS], most[OUTPUTS], total[2][OUTPUTS];
    real square[PAIRS], causes[PAIRS][SIGNATURES], gives[PAIRS], cross[WINDOWS][PAIRS][SIGNATURES];
    int age, away[OUTPUTS];
} forecast_window;

/* All that the supervisor remembers (supervise.Kept) */
typedef struct {
    moment since[KINDS][SIGNALS], last[KINDS][SIGNALS], cleared[OUTPUTS], returned[OUTPUTS], now;
    real amount[KINDS][SIGNALS];
    real x[WATCH], e[OUTPUTS], slow[OUTPUTS], expected[OUTPUTS];
    real y[OUTPUTS], quantum[OUTPUTS];
    forecast_window window[WINDOWS];
    real asked[INPUTS], usual[INPUTS], stirred[INPUTS], forward[INPUTS];
    beadline_clock clock; /* at the last sample */
    int repeats[OUTPUTS], bad[OUTPUTS], returns[OUTPUTS], shown[2][INPUTS], missing[INPUTS];
    int samples, mode, clocked, insane, active; /* active: causes that are there */
} supervisor_kept;
