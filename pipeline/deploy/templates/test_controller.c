/* Plays golden.csv: the controller on its own model, with noise, changed references, faults and hand-overs,
 * and compares every input with what the project's object asked for. Ends with 0 where all are equal. */
#include "controller.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

/* test_plant.h: the machine is simulated in double precision by either build */
#include "test_plant.h"

/* Of each input's range. A forecast of 250 degC in single precision is sure to 3e-5 degC. If an output is at a
 * limit, the governor divides that by the effect of a percent. A law that swings there magnifies it: golden.csv
 * has no episode with a gain of more than 1000 ranges per degC. One row in a hundred may differ by so much. */
#define TOLERANCE BY_PRECISION(1e-9, 1e-3)
#define MAGNIFIED BY_PRECISION(1e-9, 3e-2)
#define MAY_DIFFER BY_PRECISION(0.0, 1e-2)
#define WHOLE 4
#define NUMBERS (1 + 3 * OUTPUTS + 4 * INPUTS + DISTURBANCES)
#define LINE ((WHOLE + NUMBERS + STATES) * 32)

enum { WATCH_ONLY, STEP, HAND_OVER, RESTORE, ACKNOWLEDGE, BEGIN };

static char line[LINE];
static beadline_controller controller, saved;
static beadline_decision decision;

static int numbers(double *values, int count)
{
    char *at = line, *end;
    int i;
    for (i = 0; i < count; i++) {
        values[i] = strtod(at, &end);
        if (end == at)
            return 0;
        at = *end == ',' ? end + 1 : end;
    }
    return 1;
}

static void measure(const double *x, double *y)
{
    int i, j;
    for (j = 0; j < OUTPUTS; j++)
        for (i = 0, y[j] = plant_d[j]; i < STATES; i++)
            y[j] += plant_C[j][i] * x[i];
}

/* The disturbances take from the inputs what is fed forward */
static void heat(double *x, const double *applied, const double *disturbances)
{
    double after[STATES], acts[INPUTS];
    int i, j, q;
    for (j = 0; j < INPUTS; j++)
        for (q = 0, acts[j] = applied[j]; q < DISTURBANCES; q++)
            if (isfinite(disturbances[q]))
                acts[j] -= plant_gain[j][q] * (disturbances[q] - plant_mean[q]);
    for (i = 0; i < STATES; i++) {
        after[i] = plant_b[i];
        for (j = 0; j < STATES; j++)
            after[i] += plant_A[i][j] * x[j];
        for (j = 0; j < INPUTS; j++)
            after[i] += plant_B[i][j] * acts[j];
    }
    memcpy(x, after, sizeof after);
}

static const real *as_real(real *to, const double *from, int count)
{
    int i;
    for (i = 0; i < count; i++)
        to[i] = (real)from[i];
    return to;
}

/* The machine's clock; one of milliseconds wraps round on the way */
static beadline_clock clock_at(double t_s)
{
#ifdef BEADLINE_SINGLE
    return (beadline_clock)(uint64_t)(1e3 * t_s + 4294900000.5);
#else
    return t_s;
#endif
}

/* What the machine says of itself; anything else is refused */
static int refuses_others(void)
{
    beadline_machine right = {BEADLINE_PLANT_SHA256, BEADLINE_INPUT_UNIT, BEADLINE_OUTPUT_UNIT,
                              BEADLINE_SAMPLE_TIME_S, INPUTS, OUTPUTS};
    beadline_machine plant = right, unit = right, time_s = right, signals = right;
    plant.plant_sha256 = "0";
    unit.output_unit = "K";
    time_s.sample_time_s = 2 * BEADLINE_SAMPLE_TIME_S;
    signals.inputs = INPUTS + 1;
    return beadline_init(&controller, &plant, 1) == BEADLINE_OTHER_PLANT
           && beadline_init(&controller, &unit, 1) == BEADLINE_OTHER_UNIT
           && beadline_init(&controller, &time_s, 1) == BEADLINE_OTHER_SAMPLE_TIME
           && beadline_init(&controller, &signals, 1) == BEADLINE_OTHER_SIGNALS
           && beadline_init(&controller, &right, 0)
                  == (BEADLINE_SIMULATED ? BEADLINE_ONLY_REHEARSAL : BEADLINE_DONE)
           && beadline_init(&controller, &right, 1) == BEADLINE_DONE;
}

static int causes_of(const beadline_decision *d)
{
    int i, bits = 0;
    for (i = 0; i < d->causes; i++)
        bits |= 1 << d->cause[i].kind;
    return bits;
}

/* What is done before a step; the other copy is spoilt, so that nothing of it can be read */
static void before(int what, const real *y)
{
    if (what == HAND_OVER)
        beadline_hand_over(&controller, y);
    if (what == ACKNOWLEDGE)
        beadline_acknowledge(&controller);
    if (what == RESTORE) {
        saved = controller;
        refuses_others();
        beadline_restore(&controller, &saved, BEADLINE_CERTIFICATE_SHA256);
    }
}

typedef struct {
    long rows, modes, causes, differing, first;
    double largest, seconds;
    double x[STATES], u[INPUTS], y[OUTPUTS];
} played;

static void play(const double *row, const double *start, played *p)
{
    const double *number = row + WHOLE, *r = number + 1, *add = r + OUTPUTS, *reading = add + OUTPUTS;
    const double *manual = reading + OUTPUTS, *share = manual + INPUTS, *extra = share + INPUTS;
    const double *expected = extra + INPUTS, *disturbances = expected + INPUTS;
    double y[OUTPUTS], applied[INPUTS];
    real told[DISTURBANCES + 1], seen[OUTPUTS], asked[OUTPUTS], acted[INPUTS];
    int i, j, what = (int)row[0], differs = 0, wrong_mode, wrong_cause;
    clock_t began;
    if (what == BEGIN) {
        refuses_others();
        memcpy(p->x, start, sizeof p->x);
        memcpy(p->u, start + STATES, sizeof p->u);
        memcpy(p->y, start + STATES + INPUTS, sizeof p->y);
    }
    for (i = 0; i < INPUTS; i++)
        applied[i] = share[i] * p->u[i] + extra[i];
    measure(p->x, y);
    for (j = 0; j < OUTPUTS; j++) {
        y[j] = isnan(reading[j]) ? y[j] + add[j] : reading[j];
        if (isinf(reading[j]))
            y[j] = reading[j] > 0 ? NAN : p->y[j];
    }
    memcpy(p->y, y, sizeof y);
    as_real(told, disturbances, DISTURBANCES);
    as_real(seen, y, OUTPUTS);
    as_real(asked, r, OUTPUTS);
    if (what == WATCH_ONLY || what == BEGIN) {
        beadline_tell(&controller, told);
        memcpy(p->u, manual, sizeof p->u);
        beadline_watch(&controller, as_real(acted, p->u, INPUTS), seen, asked);
    } else {
        beadline_tell(&controller, told);
        before(what, seen);
        beadline_tell(&controller, told);
        began = clock();
        as_real(acted, applied, INPUTS);
        beadline_step(&controller, seen, asked, clock_at(number[0]),
                      row[1] > 0 && what != HAND_OVER ? acted : NULL, &decision);
        p->seconds += (double)(clock() - began) / CLOCKS_PER_SEC;
        for (i = 0; i < INPUTS; i++)
            p->u[i] = (double)decision.u[i];
        wrong_mode = decision.mode != (int)row[2];
        wrong_cause = (decision.mode == MODE_LAW ? 0 : causes_of(&decision)) != (int)row[3];
        p->modes += wrong_mode;
        p->causes += wrong_cause;
        differs = wrong_mode || wrong_cause;
    }
    for (i = 0; i < INPUTS; i++) {
        double difference = fabs(p->u[i] - expected[i]) / input_range[i];
        if (!(difference <= TOLERANCE))
            differs = 1;
        if (!(difference <= p->largest))
            p->largest = difference;
        applied[i] = share[i] * p->u[i] + extra[i];
    }
    if (differs)
        p->differing++;
    if (differs && p->first < 0)
        p->first = p->rows;
    heat(p->x, applied, disturbances);
    p->rows++;
}

int main(int count, char **arguments)
{
    static double start[STATES + INPUTS + OUTPUTS], row[WHOLE + NUMBERS];
    static played p;
    FILE *file = fopen(count > 1 ? arguments[1] : "golden.csv", "r");
    if (!refuses_others()) {
        puts("beadline_init does not refuse another machine");
        return 1;
    }
    if (!file || !fgets(line, sizeof line, file) || !numbers(start, STATES + INPUTS + OUTPUTS)) {
        puts("golden.csv is missing or broken; export the controller again");
        return 1;
    }
    p.first = -1;
    while (fgets(line, sizeof line, file)) {
        if (!numbers(row, WHOLE + NUMBERS)) {
            puts("golden.csv has a broken line; export the controller again");
            return 1;
        }
        play(row, start, &p);
    }
    fclose(file);
    printf("{\"rows\": %ld, \"largest_difference\": %.3g, ", p.rows, p.largest);
    printf("\"modes_differ\": %ld, \"causes_differ\": %ld, ", p.modes, p.causes);
    printf("\"rows_differ\": %ld, \"first_differs\": %ld, ", p.differing, p.first);
    printf("\"step_us\": %.3f, \"state_bytes\": %lu}\n", p.rows ? 1e6 * p.seconds / (double)p.rows : 0.0,
           (unsigned long)sizeof controller);
    return !(p.rows > 0 && p.largest <= MAGNIFIED && p.modes == 0 && p.causes == 0
             && (double)p.differing <= MAY_DIFFER * (double)p.rows);
}
