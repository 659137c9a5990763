/* ---- the supervisor */

/* Kinds of cause, in the order of beadline_reason */
enum {
    HEATER_STUCK_ON, HEATER_STUCK_OFF, HEATER_WEAK, THERMAL_RUNAWAY, OUT_OF_RANGE, SENSOR_NAN, SENSOR_FROZEN,
    SENSOR_OFFSET, SENSOR_SLOW, SENSOR_NOISY, COMMAND_NOT_APPLIED, CLOCK_JUMP, DEADLINE_MISSED,
    MODEL_NO_LONGER_RIGHT, REFERENCE_OUT_OF_REACH, KINDS
};
enum { MODE_LAW, MODE_HOLD, MODE_PI, MODE_OFF };

/* What the observer of the model knows, and what each fault would look like (innovations.Memory) */
typedef struct {
    double x[WATCH], X[WATCH][THETA];                              /* state, and what it would be by theta */
    double theta[OUTPUTS][THETA], P[OUTPUTS][THETA][THETA];        /* how the plant differs, learned */
    double u[2][INPUTS], sums[2][OUTPUTS];                         /* last inputs; sums of innovations */
    double before[RING][2 * INPUTS];                               /* the ring of past samples, newest last */
    double z[RING][OUTPUTS], sd[RING][OUTPUTS], dy[RING][OUTPUTS];
    double Xb[WATCH][BANK], next[WATCH][BANK], f[BANK];            /* the bank of hypotheses */
    double cross[BANK][OUTPUTS], square[BANK][OUTPUTS], own[OUTPUTS];
    double u0[INPUTS], gain[INPUTS], late;
    int age, ahead;
} innovation_memory;

/* What else the supervisor remembers (supervisor.Kept) */
typedef struct {
    double since[KINDS][SIGNALS], last[KINDS][SIGNALS], amount[KINDS][SIGNALS];
    int other[KINDS][SIGNALS], repeats[OUTPUTS];
    double y[OUTPUTS], quantum[OUTPUTS], square[OUTPUTS], lag[OUTPUTS], z[OUTPUTS], trusted[OUTPUTS];
    double absurd[OUTPUTS], expected[OUTPUTS], e[OUTPUTS], error[OUTPUTS], goal[OUTPUTS], waited[OUTPUTS];
    double drift[OUTPUTS][1 + THETA];
    double held[INPUTS], asked[INPUTS], lacks[INPUTS], stuck[INPUTS], clock_s[2];
    int samples, alarmed, mode, clocked, active; /* active: causes that are there */
} supervisor_kept;
