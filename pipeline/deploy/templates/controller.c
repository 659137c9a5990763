/* The controller of controller.h. Letters and names are those of the project's law.py and
 * supervise.py; tables.h holds the numbers. */
#include "controller.h"

#include <tgmath.h>
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
            k->since[kind][signal] = k->last[kind][signal] = -1;
    memset(k->amount, 0, sizeof k->amount);
    memset(k->returns, 0, sizeof k->returns);
    memset(k->shown, 0, sizeof k->shown);
    memset(k->missing, 0, sizeof k->missing);
    k->active = 0;
    end_windows(k);
}

beadline_result beadline_init(beadline_controller *c, const beadline_machine *machine, int rehearsal)
{
    int j, q;
    memset(c, 0, sizeof *c);
    if (strcmp(machine->plant_sha256, BEADLINE_PLANT_SHA256))
        return BEADLINE_OTHER_PLANT;
    if (machine->sample_time_s < (real)BEADLINE_SAMPLE_TIME_S
        || machine->sample_time_s > (real)BEADLINE_SAMPLE_TIME_S)
        return BEADLINE_OTHER_SAMPLE_TIME;
    if (strcmp(machine->input_unit, BEADLINE_INPUT_UNIT)
        || strcmp(machine->output_unit, BEADLINE_OUTPUT_UNIT))
        return BEADLINE_OTHER_UNIT;
    if (machine->inputs != INPUTS || machine->outputs != OUTPUTS)
        return BEADLINE_OTHER_SIGNALS;
    if (BEADLINE_SIMULATED && !rehearsal)
        return BEADLINE_ONLY_REHEARSAL;
    forget_all(&c->kept);
    for (q = 0; q < DISTURBANCES; q++)
        c->law.told[q] = c->law.before[q] = NAN;
    for (j = 0; j < OUTPUTS; j++) {
        c->kept.y[j] = NAN;
        c->kept.quantum[j] = INFINITY;
        c->kept.cleared[j] = c->kept.returned[j] = NEVER;
    }
    c->ready = 1;
    return BEADLINE_DONE;
}

/* What a change of a disturbance adds for some samples */
static real kick_of(const law_state *s, int q)
{
    real moved = s->told[q] - s->before[q];
    return FADES * s->kick[q] + (isfinite(moved) ? moved : 0);
}

static void feed_forward(law_state *s)
{
    int i, q;
    for (i = 0; i < INPUTS; i++)
        for (q = 0, s->forward[i] = 0; q < DISTURBANCES; q++)
            if (isfinite(s->told[q]))
                s->forward[i] += forward_gain[i][q]
                                 * (s->told[q] - forward_mean[q] + forward_lead[q] * kick_of(s, q));
}

/* A sample on, with the disturbances as they were told */
static void pass_disturbances(law_state *s)
{
    int q;
    for (q = 0; q < DISTURBANCES; q++) {
        s->kick[q] = kick_of(s, q);
        if (isfinite(s->told[q]))
            s->before[q] = s->told[q];
    }
    feed_forward(s);
}

beadline_result beadline_tell(beadline_controller *c, const real *disturbances)
{
    if (!c->ready)
        return BEADLINE_NOT_READY;
    memcpy(c->law.told, disturbances, DISTURBANCES * sizeof *disturbances);
    feed_forward(&c->law);
    return BEADLINE_DONE;
}

/* The target of reference r, found anew where r changed, and whether it is in reach */
static void turn_to(beadline_controller *c, const real *r)
{
    real u[INPUTS];
    int j, reached = 1;
    if (c->aimed && !memcmp(c->r, r, sizeof c->r))
        return;
    memcpy(c->r, r, sizeof c->r);
    feasible_target(&the_law, r, u, c->y_star);
    for (j = 0; j < OUTPUTS; j++) {
        real outside = fmax(r[j] - supervisor_hottest[j], supervisor_coldest[j] - r[j]);
        c->beyond[j] = fmax(fabs(c->y_star[j] - r[j]), outside);
        reached &= c->beyond[j] <= REACH_DEGC;
    }
    if (reached)
        memcpy(c->in_reach, r, sizeof c->in_reach);
    c->has_reached |= reached;
    c->aimed = 1;
}

beadline_result beadline_watch(beadline_controller *c, const real *u, const real *y, const real *r)
{
    real filled[OUTPUTS];
    if (!c->ready)
        return BEADLINE_NOT_READY;
    if (!all_finite(u, INPUTS) || !all_finite(r, OUTPUTS))
        return BEADLINE_BAD_INPUT;
    turn_to(c, r);
    follow(&c->kept, y, NULL, 0, filled);
    c->kept.now += SAMPLE_TIME;
    memcpy(c->kept.asked, u, sizeof c->kept.asked);
    memcpy(c->kept.forward, c->law.forward, sizeof c->kept.forward);
    law_watch(&the_law, &c->law, u, filled, r);
    pass_disturbances(&c->law);
    return BEADLINE_DONE;
}

beadline_result beadline_hand_over(beadline_controller *c, const real *y)
{
    real filled[OUTPUTS];
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
    return BEADLINE_DONE;
}

beadline_result beadline_restore(beadline_controller *c, const beadline_controller *saved,
                                 const char *certificate_sha256)
{
    if (!c->ready)
        return BEADLINE_NOT_READY;
    if (strcmp(certificate_sha256, BEADLINE_CERTIFICATE_SHA256) || !saved->ready)
        return BEADLINE_OTHER_SAVE;
    if (!all_finite(saved->law.z, MEMORY + OUTPUTS + INPUTS) || !all_finite(saved->kept.x, WATCH))
        return BEADLINE_BAD_INPUT;
    *c = *saved;
    if (c->kept.mode != MODE_OWN)
        c->fallback.seen = 0; /* the fallback begins anew, as where the object is restored */
    return BEADLINE_DONE;
}

/* Inputs of a safe mode; off, too, if there is no control of the machine's own */
static void be_safe(beadline_controller *c, int mode, const real *y, const real *r, real *u)
{
    supervisor_kept *k = &c->kept;
    if (mode == MODE_OFF || !HAS_FALLBACK) {
        memcpy(u, the_law.low, INPUTS * sizeof *u);
        return;
    }
    if (k->mode != MODE_OWN) {
        memset(&c->fallback, 0, sizeof c->fallback);
        memcpy(c->fallback.forward, c->law.forward, sizeof c->law.forward);
        law_watch(&the_fallback, &c->fallback, k->asked, y, r);
        law_hand_over(&the_fallback, &c->fallback, y);
    }
    memcpy(c->fallback.forward, c->law.forward, sizeof c->law.forward);
    law_step(&the_fallback, &c->fallback, y, r, u);
}

/* Inputs of the mode that the causes ask for; the law watches where it does not drive */
static int drive(beadline_controller *c, const real *y, const real *r, real *u)
{
    supervisor_kept *k = &c->kept;
    int mode = find_mode(k);
    if (mode == MODE_LAW) {
        if (k->mode != MODE_LAW)
            law_hand_over(&the_law, &c->law, y);
        law_step(&the_law, &c->law, y, r, u);
    } else {
        be_safe(c, mode, y, r, u);
        law_watch(&the_law, &c->law, u, y, r);
    }
    memcpy(k->asked, u, sizeof k->asked);
    memcpy(k->forward, c->law.forward, sizeof k->forward);
    pass_disturbances(&c->law);
    k->mode = mode;
    return mode;
}

/* Every cause that is there, the first kind first */
static void tell_causes(const beadline_controller *c, beadline_clock t, beadline_decision *d)
{
    const supervisor_kept *k = &c->kept;
    int kind, signal;
    for (kind = 0; kind < KINDS; kind++)
        for (signal = 0; signal < SIGNALS; signal++)
            if (k->since[kind][signal] >= 0) {
                beadline_cause *one = &d->cause[d->causes++];
                one->kind = kind;
                one->signal = signal;
                one->amount = k->amount[kind][signal];
                one->since = t - (beadline_clock)(k->now - k->since[kind][signal]);
            }
}

beadline_result beadline_step(beadline_controller *c, const real *y, const real *r, beadline_clock t,
                              const real *applied, beadline_decision *decision)
{
    supervisor_kept *k = &c->kept;
    real filled[OUTPUTS];
    int j, samples, out_of_reach, farthest = 0;
    if (!c->ready || !c->law.seen)
        return BEADLINE_NOT_READY;
    if (!all_finite(r, OUTPUTS) || !TELLS(t))
        return BEADLINE_BAD_INPUT;
    samples = pass_time(k, t);
    turn_to(c, r);
    follow(k, y, applied, samples, filled);
    for (j = 1; j < OUTPUTS; j++)
        if (c->beyond[j] > c->beyond[farthest])
            farthest = j;
    out_of_reach = c->beyond[farthest] > REACH_DEGC;
    if (out_of_reach)
        say(k, REFERENCE_OUT_OF_REACH, farthest, c->beyond[farthest]);
    if (out_of_reach && !c->has_reached) {
        memcpy(c->in_reach, filled, sizeof filled);
        c->has_reached = 1;
    }
    decision->causes = 0;
    decision->mode = drive(c, filled, out_of_reach ? c->in_reach : r, decision->u);
    if (decision->mode != MODE_LAW)
        tell_causes(c, t, decision);
    return BEADLINE_DONE;
}
