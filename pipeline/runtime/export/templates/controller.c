/* The controller of controller.h. Letters and names are those of the project's controller.py, governor.py,
 * innovations.py and supervisor.py; tables.h holds the numbers. */
#include "controller.h"

#include <math.h>
#include <string.h>

@law.c@
@supervisor.c@

/* ---- the controller */

const char *beadline_why(beadline_result result)
{
    switch (result) {
    case BEADLINE_DONE:
        return "done";
    case BEADLINE_OTHER_PLANT:
        return "the certificate is of another plant; certify a controller for this machine";
    case BEADLINE_OTHER_SAMPLE_TIME:
        return "the certificate is of another sample time; sample as machine.h says";
    case BEADLINE_OTHER_UNIT:
        return "the certificate is of other units; convert the signals as machine.h says";
    case BEADLINE_OTHER_SIGNALS:
        return "the machine has other inputs or outputs; wire those of machine.h, in order";
    case BEADLINE_ONLY_REHEARSAL:
        return "made for a simulated plant, it runs only in a rehearsal; learn it from recordings";
    case BEADLINE_NOT_READY:
        return "call beadline_init, then beadline_watch with each sample in manual, first";
    case BEADLINE_BAD_INPUT:
        return "a number is not finite; give the last one that was";
    default:
        return "saved by another controller; restore what this one saved";
    }
}

const char *beadline_reason(int kind)
{
    return kind >= 0 && kind < KINDS ? reasons[kind] : "no such kind";
}

static void forget_all(supervisor_kept *k)
{
    int kind, signal;
    for (kind = 0; kind < KINDS; kind++)
        for (signal = 0; signal < SIGNALS; signal++)
            k->since[kind][signal] = k->last[kind][signal] = -1.0;
    memset(k->lacks, 0, sizeof k->lacks);
    memset(k->stuck, 0, sizeof k->stuck);
    memset(k->absurd, 0, sizeof k->absurd);
    memset(k->error, 0, sizeof k->error);
    memset(k->waited, 0, sizeof k->waited);
    k->samples = 0;
    k->active = 0;
    k->alarmed = -1;
}

beadline_result beadline_init(beadline_controller *c, const beadline_machine *machine, int rehearsal)
{
    int i, j, kind, signal;
    memset(c, 0, sizeof *c);
    if (strcmp(machine->plant_sha256, BEADLINE_PLANT_SHA256))
        return BEADLINE_OTHER_PLANT;
    if (machine->sample_time_s < BEADLINE_SAMPLE_TIME_S || machine->sample_time_s > BEADLINE_SAMPLE_TIME_S)
        return BEADLINE_OTHER_SAMPLE_TIME;
    if (strcmp(machine->input_unit, BEADLINE_INPUT_UNIT)
        || strcmp(machine->output_unit, BEADLINE_OUTPUT_UNIT))
        return BEADLINE_OTHER_UNIT;
    if (machine->inputs != INPUTS || machine->outputs != OUTPUTS)
        return BEADLINE_OTHER_SIGNALS;
    if (BEADLINE_SIMULATED && !rehearsal)
        return BEADLINE_ONLY_REHEARSAL;
    forget_all(&c->kept);
    rest_observer(&c->memory);
    for (kind = 0; kind < KINDS; kind++)
        for (signal = 0; signal < SIGNALS; signal++)
            c->kept.other[kind][signal] = -1;
    for (j = 0; j < OUTPUTS; j++) {
        c->kept.y[j] = NAN;
        c->kept.quantum[j] = INFINITY;
        c->kept.square[j] = 1.0;
        c->kept.trusted[j] = 1.0;
        c->kept.goal[j] = -INFINITY;
        for (i = 0; i < THETA; i++)
            c->memory.P[j][i][i] = watch_prior[i] * watch_prior[i];
        for (i = 0; i < RING; i++)
            c->memory.sd[i][j] = 1.0;
    }
    for (i = 0; i < INPUTS; i++)
        c->memory.gain[i] = 1.0;
    c->ready = 1;
    return BEADLINE_DONE;
}

/* The target of reference r, found anew where r changed, and whether it is in reach */
static void turn_to(beadline_controller *c, const double *r)
{
    double u[INPUTS];
    int j, reached = 1;
    if (c->aimed && !memcmp(c->r, r, sizeof c->r))
        return;
    memcpy(c->r, r, sizeof c->r);
    feasible_target(&the_law, r, u, c->y_star);
    for (j = 0; j < OUTPUTS; j++) {
        double outside = fmax(r[j] - supervisor_high[j], supervisor_low[j] - r[j]);
        c->beyond[j] = fmax(fabs(c->y_star[j] - r[j]), outside);
        reached &= c->beyond[j] <= REACH_DEGC;
    }
    if (reached)
        memcpy(c->in_reach, r, sizeof c->in_reach);
    c->has_reached |= reached;
    c->aimed = 1;
}

beadline_result beadline_watch(beadline_controller *c, const double *u, const double *y, const double *r)
{
    double filled[OUTPUTS];
    if (!c->ready)
        return BEADLINE_NOT_READY;
    if (!all_finite(u, INPUTS) || !all_finite(r, OUTPUTS))
        return BEADLINE_BAD_INPUT;
    turn_to(c, r);
    follow(&c->kept, &c->memory, y, c->y_star, NULL, 0, filled);
    c->kept.clock_s[1] += BEADLINE_SAMPLE_TIME_S;
    memcpy(c->kept.asked, u, sizeof c->kept.asked);
    memcpy(c->kept.held, u, sizeof c->kept.held);
    law_watch(&the_law, &c->law, u, filled, r);
    return BEADLINE_DONE;
}

beadline_result beadline_hand_over(beadline_controller *c, const double *y)
{
    double filled[OUTPUTS];
    int j;
    if (!c->ready || !c->law.seen)
        return BEADLINE_NOT_READY;
    for (j = 0; j < OUTPUTS; j++)
        filled[j] = isfinite(y[j]) ? y[j] : c->kept.expected[j];
    law_hand_over(&the_law, &c->law, filled);
    return BEADLINE_DONE;
}

beadline_result beadline_acknowledge(beadline_controller *c)
{
    if (!c->ready)
        return BEADLINE_NOT_READY;
    forget_all(&c->kept);
    rest_observer(&c->memory);
    return BEADLINE_DONE;
}

beadline_result beadline_restore(beadline_controller *c, const beadline_controller *saved,
                                 const char *certificate_sha256)
{
    if (!c->ready)
        return BEADLINE_NOT_READY;
    if (strcmp(certificate_sha256, BEADLINE_CERTIFICATE_SHA256) || !saved->ready)
        return BEADLINE_OTHER_SAVE;
    if (!all_finite(saved->law.z, MEMORY + OUTPUTS + INPUTS) || !all_finite(saved->memory.x, WATCH))
        return BEADLINE_BAD_INPUT;
    *c = *saved;
    if (c->kept.mode != MODE_PI)
        c->fallback.seen = 0; /* the fallback begins anew, as where the object is restored */
    return BEADLINE_DONE;
}

/* Inputs of a safe mode */
static void be_safe(beadline_controller *c, int mode, const double *y, const double *r, double *u)
{
    supervisor_kept *k = &c->kept;
    int i;
    if (mode == MODE_PI) {
        if (k->mode != MODE_PI) {
            law_watch(&the_fallback, &c->fallback, k->asked, y, r);
            law_hand_over(&the_fallback, &c->fallback, y);
        }
        law_step(&the_fallback, &c->fallback, y, r, u);
        return;
    }
    for (i = 0; i < INPUTS; i++)
        u[i] = mode == MODE_OFF ? the_law.low[i] : cut(k->held[i], the_law.low[i], the_law.high[i]);
}

/* Inputs of the mode that the causes ask for; the law watches where it does not drive */
static int drive(beadline_controller *c, const double *y, const double *r, double *u)
{
    supervisor_kept *k = &c->kept;
    int i, j, settled = 1, mode = find_mode(k);
    if (mode == MODE_PI && !HAS_FALLBACK)
        mode = MODE_HOLD;
    if (mode == MODE_LAW) {
        if (k->mode != MODE_LAW)
            law_hand_over(&the_law, &c->law, y);
        law_step(&the_law, &c->law, y, r, u);
        for (j = 0; j < OUTPUTS; j++)
            settled &= fabs(y[j] - c->y_star[j]) < SETTLED_DEGC;
        for (i = 0; i < INPUTS && settled; i++)
            k->held[i] += HELD_SHARE * (u[i] - k->held[i]);
    } else {
        be_safe(c, mode, y, r, u);
        law_watch(&the_law, &c->law, u, y, r);
    }
    memcpy(k->asked, u, sizeof k->asked);
    k->mode = mode;
    return mode;
}

static void add_cause(beadline_decision *d, int kind, int signal, int other, double amount, double since_s)
{
    beadline_cause *one = &d->cause[d->causes++];
    one->kind = kind;
    one->signal = signal;
    one->other = other;
    one->amount = amount;
    one->since_s = since_s;
}

static int of_input(int kind)
{
    return kind <= HEATER_WEAK || kind == COMMAND_NOT_APPLIED;
}

/* Every cause that is there, the first kind first; while none is decided, the output that raised the alarm */
static void tell_causes(const beadline_controller *c, double t_s, beadline_decision *d)
{
    const supervisor_kept *k = &c->kept;
    int kind, signal;
    for (kind = 0; kind < KINDS; kind++)
        for (signal = 0; signal < SIGNALS; signal++)
            if (k->since[kind][signal] >= 0) {
                int other = k->other[kind][signal];
                int of = other != ALL_INPUTS
                         && (of_input(kind) || of_output(kind) || kind == REFERENCE_OUT_OF_REACH);
                add_cause(d, kind, of ? signal : -1, other == kind ? -1 : other < 0 ? -1 : other,
                          k->amount[kind][signal], t_s - (k->clock_s[1] - k->since[kind][signal]));
            }
    if (d->causes)
        return;
    add_cause(d, MODEL_NO_LONGER_RIGHT, loudest(&c->memory), -1, 0.0,
              t_s - k->alarmed * BEADLINE_SAMPLE_TIME_S);
}

beadline_result beadline_step(beadline_controller *c, const double *y, const double *r, double t_s,
                              const double *applied, beadline_decision *decision)
{
    supervisor_kept *k = &c->kept;
    double filled[OUTPUTS];
    int j, samples, out_of_reach, farthest = 0;
    if (!c->ready || !c->law.seen)
        return BEADLINE_NOT_READY;
    if (!all_finite(r, OUTPUTS) || !isfinite(t_s))
        return BEADLINE_BAD_INPUT;
    if (!k->clocked) {
        k->clock_s[0] = t_s - BEADLINE_SAMPLE_TIME_S;
        k->clocked = 1;
    }
    samples = tell_time(k, t_s);
    turn_to(c, r);
    follow(k, &c->memory, y, c->y_star, applied, samples, filled);
    for (j = 1; j < OUTPUTS; j++)
        if (c->beyond[j] > c->beyond[farthest])
            farthest = j;
    out_of_reach = c->beyond[farthest] > REACH_DEGC;
    if (out_of_reach)
        say(k, REFERENCE_OUT_OF_REACH, farthest, c->beyond[farthest], -1);
    if (out_of_reach && !c->has_reached) {
        memcpy(c->in_reach, filled, sizeof filled);
        c->has_reached = 1;
    }
    if (!out_of_reach && (k->mode == MODE_LAW || k->mode == MODE_PI))
        verify_heaters(k, filled, c->y_star);
    decision->causes = 0;
    decision->mode = drive(c, filled, out_of_reach ? c->in_reach : r, decision->u);
    if (decision->mode != MODE_LAW)
        tell_causes(c, t_s, decision);
    return BEADLINE_DONE;
}
