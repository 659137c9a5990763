/* A controller of heaters for one machine, with limits, governor, hand-over and supervisor. C99, no heap, no
 * clock, no file. Inputs in percent, outputs in degC, in the order of machine.h.
 *
 *     beadline_init                    once; refuses another plant, unit or sample time
 *     beadline_watch                   each sample in manual, at least one
 *     beadline_hand_over               once, when the law takes over
 *     beadline_step                    each sample from then on
 *     beadline_tell                    before each of them, if machine.h has DISTURBANCES
 *
 * All that it remembers lies in a beadline_controller: to save it, copy it; beadline_restore goes on from the
 * copy. One thread at a time may use one.
 */
#ifndef BEADLINE_CONTROLLER_H
#define BEADLINE_CONTROLLER_H

#include "machine.h"

/* Every number is a `real`. With -DBEADLINE_SINGLE it is a float, and a clock counts whole milliseconds: a
 * float of seconds has no milliseconds left after a day. The clock may wrap round. */
#ifdef BEADLINE_SINGLE
#include <stdint.h>
typedef float real;
typedef uint32_t beadline_clock; /* ms */
typedef int64_t moment;          /* ms of the controller's own time, which never falls */
#define REAL(number) number##f
#define BY_PRECISION(double_precision, single_precision) single_precision##f
#define SECOND REAL(1e3)
#define SECONDS(s) ((moment)(SECOND * (s) + REAL(0.5)))
#define NEVER (INT64_MIN / 2)
#define TELLS(clock) 1
#else
typedef double real;
typedef double beadline_clock; /* s */
typedef double moment;
#define REAL(number) number
#define BY_PRECISION(double_precision, single_precision) double_precision
#define SECOND 1.0
#define SECONDS(s) (s)
#define NEVER (-INFINITY)
#define TELLS(clock) isfinite(clock)
#endif
#define SAMPLE_TIME SECONDS((real)BEADLINE_SAMPLE_TIME_S)

@law.h@
@supervisor.h@
/* ---- the controller */

typedef struct {
    law_state law, fallback;
    supervisor_kept kept;
    real r[OUTPUTS], y_star[OUTPUTS];       /* reference and target */
    real beyond[OUTPUTS], in_reach[OUTPUTS]; /* degC beyond reach; the last reference in reach */
    int aimed, has_reached, ready;
} beadline_controller;

/* Why a call did nothing */
typedef enum {
    BEADLINE_DONE,
    BEADLINE_OTHER_PLANT,
    BEADLINE_OTHER_SAMPLE_TIME,
    BEADLINE_OTHER_UNIT,
    BEADLINE_OTHER_SIGNALS,
    BEADLINE_ONLY_REHEARSAL,
    BEADLINE_NOT_READY,
    BEADLINE_BAD_INPUT,
    BEADLINE_OTHER_SAVE
} beadline_result;

/* The machine as the caller knows it */
typedef struct {
    const char *plant_sha256, *input_unit, *output_unit;
    real sample_time_s;
    int inputs, outputs;
} beadline_machine;

/* A cause of a safe mode: `signal` is the number of an input or output. The amount of a heater, as a share of
 * its command, is negative if its sensor may be at fault as well. */
typedef struct {
    int kind, signal;
    real amount;
    beadline_clock since;
} beadline_cause;

typedef struct {
    real u[INPUTS]; /* percent, to apply */
    int mode, causes;
    beadline_cause cause[KINDS * SIGNALS];
} beadline_decision;

/* Makes c ready. `rehearsal` 1: a controller of a simulated plant may run, beside a simulation only. */
beadline_result beadline_init(beadline_controller *c, const beadline_machine *machine, int rehearsal);

/* The disturbances from this sample on, in the order of machine.h, NAN for one that is not known */
beadline_result beadline_tell(beadline_controller *c, const real *disturbances);

/* One sample in manual: inputs u were applied, outputs y measured before, reference r */
beadline_result beadline_watch(beadline_controller *c, const real *u, const real *y, const real *r);

/* From manual to the law without a bump, at outputs y measured now */
beadline_result beadline_hand_over(beadline_controller *c, const real *y);

/* What to apply from outputs y measured at t of the machine's clock, NAN where a sensor gives none, under
 * the constant reference r. `applied`: inputs that acted since the last sample, NULL where nothing reads them
 * back. */
beadline_result beadline_step(beadline_controller *c, const real *y, const real *r, beadline_clock t,
                              const real *applied, beadline_decision *decision);

/* A person has mended what was wrong: every cause is forgotten */
beadline_result beadline_acknowledge(beadline_controller *c);

/* Goes on from a copy that was saved from this controller, of this certificate */
beadline_result beadline_restore(beadline_controller *c, const beadline_controller *saved,
                                 const char *certificate_sha256);

/* A result, or a kind of cause, in one sentence */
const char *beadline_why(beadline_result result);
const char *beadline_reason(int kind);

#endif
