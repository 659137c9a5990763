/* An exported controller on a heated machine: normal life, and one fault in it. */
#include "controller.c" /* whole: what a fault's model predicts is told by the tables and functions in it */
#include "thermal_machine.h"

enum {
    FAULT_NO_FAULT, FAULT_SENSOR_OPEN, FAULT_SENSOR_RANGE, FAULT_SENSOR_STILL, FAULT_SENSOR_STILL_NOISY, FAULT_HEATER_ON, FAULT_HEATER_HALF, FAULT_HEATER_OFF,
    OUT_OF_REACH, FAULT_SENSOR_NEAR, FAULT_SENSOR_DRIFTS
};

/* What happened to the fault: the sample at which it began, and that from which it shows; -1 for never */
typedef struct {
    int began, shows;
} life_fault;

/* Noise by a fault, of its own generator, so that the machine's stays the same */
static double rough(unsigned *x)
{
    double sum = -6.0;
    int i;
    for (i = 0; i < 12; i++) {
        *x = *x * 1664525u + 1013904223u;
        sum += *x / 4294967296.0;
    }
    return sum;
}

/* The controller's model free of readings, from its state at sample `began` */
typedef struct {
    double state[WATCH], from[OUTPUTS];
} life_model;

static void begin_model(life_model *model, const supervisor_kept *k)
{
    int j;
    memcpy(model->state, k->x, sizeof model->state);
    add_product(model->state, supervisor_M[0], k->e, WATCH, OUTPUTS);
    for (j = 0; j < OUTPUTS; j++)
        model->from[j] = forecast(model->state, j);
}

static void advance_model(life_model *model, const double *u)
{
    double on[WATCH];
    memcpy(on, supervisor_b, sizeof on);
    add_product(on, supervisor_B[0], u, WATCH, INPUTS);
    move_state(model->state, on);
}

/* What a forecast of `age` samples tells from doubt, in degC: its own threshold, with the sensor's true steps */
static double sure_degC(const thermal_parts *p, int j, int age, double visible)
{
    double coarse = largest(1.0, p->step[j] / sqrt(12.0) / supervisor_noise[j]);
    int last = age < WINDOWS * SPACING ? age : WINDOWS * SPACING;
    return largest(visible, NOISE_STILL * supervisor_unsure[last][j] * coarse);
}

/* `steps` samples under set-points r (steps, OUTPUTS) and what acts from outside (steps, OUTSIDE): `cold` of them in
 * manual with the heaters off, then under the controller. `patience` samples after it left the law a person
 * acknowledges; 0: nobody comes. A fault of `kind` on `signal` begins at the first sample from `earliest` on at
 * which the law drives; nobody acknowledges from then on. From where it shows:
 * a sensor that stands still: the controller's own model, free of readings since the fault and fed the same
 * commands, has moved by `visible` degC (OUTPUTS);
 * a heater: the sensors of a healthy twin under the same commands are so far from the machine's, and farther than
 * the supervisor doubts a forecast of that age;
 * a sensor near its set-point, or that drifts: so far from the truth.
 *
 * Writes readings y, sensors before noise and steps, commands u, modes, the first cause's kind and signal (-1:
 * none), and whether a person acknowledged. Returns the result of the first call that did nothing, or 0. */
int normal_life(const thermal_parts *p, double degC, uint64_t seed, int steps, int cold, int patience,
                const double *r, const double *outside, int kind, int signal, int earliest, double beyond,
                const double *visible, double *y, double *sensor, double *u, signed char *modes,
                signed char *causes, signed char *signals, signed char *acknowledged, life_fault *fault,
                const double *told)
{
    static beadline_controller c;
    beadline_machine machine = {BEADLINE_PLANT_SHA256, BEADLINE_INPUT_UNIT, BEADLINE_OUTPUT_UNIT,
                                BEADLINE_SAMPLE_TIME_S, INPUTS, OUTPUTS};
    thermal_state s, twin;
    life_model model;
    beadline_decision d;
    double frozen = 0.0, acted[HEATERS], off[INPUTS] = {0}, wish[OUTPUTS], unread[SENSORS];
    int heater = kind >= FAULT_HEATER_ON && kind <= FAULT_HEATER_OFF;
    int still = kind == FAULT_SENSOR_STILL || kind == FAULT_SENSOR_STILL_NOISY;
    int k, j, left = 0, result = beadline_init(&c, &machine, 1), before = MODE_LAW;
    unsigned random = 12345u;
    fault->began = fault->shows = -1;
    thermal_start(&s, p, degC, seed);
    twin = s;
    for (k = 0; k < steps && !result; k++) {
        double *now = y + k * OUTPUTS, *command = u + k * INPUTS;
        thermal_read(&s, p, now);
        if (kind && fault->began < 0 && k >= earliest && k > cold && before == MODE_LAW && !c.kept.active) {
            fault->began = k;
            twin = s;
            frozen = now[signal];
        }
        for (j = 0; j < OUTPUTS; j++) {
            sensor[k * OUTPUTS + j] = s.sensor[j];
            wish[j] = r[k * OUTPUTS + j];
        }
        if (fault->began >= 0) {
            if (kind == FAULT_SENSOR_OPEN)
                now[signal] = NAN;
            if (kind == FAULT_SENSOR_RANGE)
                now[signal] = beyond;
            if (kind == FAULT_SENSOR_STILL)
                now[signal] = frozen;
            if (kind == FAULT_SENSOR_STILL_NOISY)
                now[signal] = rint((frozen + p->noise[signal] * rough(&random)) / p->step[signal]) * p->step[signal];
            if (kind == FAULT_SENSOR_NEAR)
                now[signal] = rint((wish[signal] - beyond + p->noise[signal] * rough(&random)) / p->step[signal]) * p->step[signal];
            if (kind == FAULT_SENSOR_DRIFTS)
                now[signal] -= beyond * (k - fault->began);
            if (kind == OUT_OF_REACH)
                wish[signal] = beyond;
            if (k > fault->began)
                advance_model(&model, u + (k - 1) * INPUTS);
            if (fault->shows < 0) {
                int open = kind <= FAULT_SENSOR_RANGE || kind == OUT_OF_REACH;
                double apart = open ? INFINITY : 0.0;
                if (still && k > fault->began)
                    apart = fabs(forecast(model.state, signal) - model.from[signal]) / visible[signal];
                if (kind > OUT_OF_REACH)
                    apart = fabs(now[signal] - s.sensor[signal]) / visible[signal];
                for (j = 0; j < OUTPUTS && heater; j++)
                    apart = fmax(apart, fabs(s.sensor[j] - twin.sensor[j])
                                            / sure_degC(p, j, k - fault->began, visible[j]));
                if (apart >= 1.0)
                    fault->shows = k;
            }
        }
        if (DISTURBANCES)
            result = beadline_tell(&c, told + k * DISTURBANCES);
        causes[k] = signals[k] = -1;
        acknowledged[k] = 0;
        if (k < cold) {
            result = beadline_watch(&c, off, now, wish);
            for (j = 0; j < INPUTS; j++)
                command[j] = 0.0;
            modes[k] = MODE_LAW;
        } else {
            if (k == cold && (result = beadline_hand_over(&c, now)))
                break;
            result = beadline_step(&c, now, wish, k * BEADLINE_SAMPLE_TIME_S, 0, &d);
            for (j = 0; j < INPUTS; j++)
                command[j] = d.u[j];
            modes[k] = (signed char)d.mode;
            before = d.mode;
            if (k == fault->began)
                begin_model(&model, &c.kept);
            if (d.mode != MODE_LAW && d.causes) {
                causes[k] = (signed char)d.cause[0].kind;
                signals[k] = (signed char)d.cause[0].signal;
            }
            left = d.mode == MODE_LAW ? 0 : left + 1;
            if (patience && left >= patience && fault->began < 0) {
                beadline_acknowledge(&c);
                acknowledged[k] = 1;
                left = 0;
            }
        }
        for (j = 0; j < INPUTS; j++)
            acted[j] = command[j];
        if (fault->began >= 0) {
            double of[] = {100.0, 0.5 * acted[signal], 0.0};
            if (heater)
                acted[signal] = of[kind - FAULT_HEATER_ON];
            thermal_read(&twin, p, unread); /* keeps its noise in step */
            thermal_advance(&twin, p, command, outside + k * OUTSIDE);
        }
        thermal_advance(&s, p, acted, outside + k * OUTSIDE);
    }
    return result;
}

/* `steps` samples from the state s, without a fault: `held` of them in manual at the duties `manual`, then under the
 * controller. The other arguments are those of normal_life. */
int held_life(const thermal_parts *p, thermal_state *s, int steps, int held, int patience, const double *manual,
              const double *r, const double *outside, double *y, double *sensor, double *u, signed char *modes,
              signed char *causes, const double *told)
{
    static beadline_controller c;
    beadline_machine machine = {BEADLINE_PLANT_SHA256, BEADLINE_INPUT_UNIT, BEADLINE_OUTPUT_UNIT,
                                BEADLINE_SAMPLE_TIME_S, INPUTS, OUTPUTS};
    beadline_decision d;
    int k, left = 0, result = beadline_init(&c, &machine, 1);
    for (k = 0; k < steps && !result; k++) {
        double *now = y + k * OUTPUTS, *command = u + k * INPUTS;
        thermal_read(s, p, now);
        memcpy(sensor + k * OUTPUTS, s->sensor, OUTPUTS * sizeof *sensor);
        if (DISTURBANCES)
            result = beadline_tell(&c, told + k * DISTURBANCES);
        causes[k] = -1;
        modes[k] = MODE_LAW;
        if (k < held) {
            result = beadline_watch(&c, manual, now, r + k * OUTPUTS);
            memcpy(command, manual, INPUTS * sizeof *command);
        } else {
            if (k == held && (result = beadline_hand_over(&c, now)))
                break;
            result = beadline_step(&c, now, r + k * OUTPUTS, k * BEADLINE_SAMPLE_TIME_S, 0, &d);
            memcpy(command, d.u, INPUTS * sizeof *command);
            modes[k] = (signed char)d.mode;
            if (d.mode != MODE_LAW && d.causes)
                causes[k] = (signed char)d.cause[0].kind;
            left = d.mode == MODE_LAW ? 0 : left + 1;
            if (patience && left >= patience) {
                beadline_acknowledge(&c);
                left = 0;
            }
        }
        thermal_advance(s, p, command, outside + k * OUTSIDE);
    }
    return result;
}

const char *life_reason(int kind)
{
    return beadline_reason(kind);
}

int life_simulated(void)
{
    return BEADLINE_SIMULATED;
}
