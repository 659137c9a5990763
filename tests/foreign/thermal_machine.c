/* A heated machine as a network of masses, integrated apart from the product. For node i
 *
 *     C_i dT_i/dt = sum_h P_h s_h + sum_e q_e - a_i (T_i - T_0) - k_i (1 + f_i fan) |T_i - T_0|^(5/4)
 *                   - e_i (T_i^4 - T_0^4) - d_i door (T_i - T_0) - c_i flow (T_i - T_0)
 *                   + w_i flow^1.4 exp(-0.012 (T_i - 200)) + sum_l c_l flow (T_l - T_i)
 *
 * with T_0 the room, s_h 0 or 1 by pulse width, q_e = (g + n (1 + b fan) |dT|^(1/4)) dT along an edge, and T_l
 * what left the upstream node one filling of the line before: at rest it stands. Shear falls with the
 * temperature, as the viscosity does. A sensor lags one node, then noise and the converter's steps come. */
#include "thermal_machine.h"

#include <math.h>
#include <string.h>

#define KELVIN 273.15

/* splitmix64, and the sum of twelve uniforms for a normal: plain arithmetic, the same bytes everywhere */
static double uniform(uint64_t *x)
{
    uint64_t z = (*x += 0x9E3779B97F4A7C15ull);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9ull;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBull;
    return (double)((z ^ (z >> 31)) >> 11) / 9007199254740992.0;
}

static double normal(uint64_t *x)
{
    double sum = -6.0;
    int i;
    for (i = 0; i < 12; i++)
        sum += uniform(x);
    return sum;
}

/* |x|^(1/4) x */
static double bent(double x)
{
    return x * sqrt(sqrt(fabs(x)));
}

static double fourth(double degC)
{
    double square = (degC + KELVIN) * (degC + KELVIN);
    return square * square;
}

void thermal_start(thermal_state *s, const thermal_parts *p, double degC, uint64_t seed)
{
    int i, k;
    (void)p;
    memset(s, 0, sizeof *s);
    for (i = 0; i < NODES; i++)
        s->degC[i] = degC;
    for (i = 0; i < SENSORS; i++)
        s->sensor[i] = degC;
    for (i = 0; i < LINES; i++)
        for (k = 0; k < CELLS; k++)
            s->line[i][k] = degC;
    for (i = 0; i < HEATERS; i++)
        s->pulse[i] = INFINITY; /* the first duty begins a pulse */
    s->random = seed;
}

void thermal_read(thermal_state *s, const thermal_parts *p, double *y)
{
    int j;
    for (j = 0; j < (int)p->sensors; j++)
        y[j] = rint((s->sensor[j] + p->noise[j] * normal(&s->random)) / p->step[j]) * p->step[j];
}

/* Heat in W into every node, with `arriving` degC at the lines' ends */
static void heat_into(const thermal_parts *p, const double *degC, const double *arriving, const double *watt,
                      const double *outside, double *heat)
{
    double room = outside[ROOM], cold = fourth(room), sheared = outside[FLOW] * pow(outside[FLOW], 0.4);
    int i, e, h, l;
    for (i = 0; i < (int)p->nodes; i++) {
        double above = degC[i] - room;
        heat[i] = -(p->linear[i] + p->door[i] * outside[DOOR] + p->feed[i] * outside[FLOW]) * above;
        if (p->convection[i] > 0)
            heat[i] -= p->convection[i] * (1 + p->fan[i] * outside[FAN]) * bent(above);
        if (p->radiation[i] > 0)
            heat[i] -= p->radiation[i] * (fourth(degC[i]) - cold);
        if (p->shear[i] > 0)
            heat[i] += p->shear[i] * sheared * exp(-0.012 * (degC[i] - 200));
    }
    for (e = 0; e < (int)p->edges; e++) {
        int a = (int)p->from[e], b = (int)p->to[e];
        double apart = degC[a] - degC[b], flow = p->conduction[e] * apart;
        if (p->natural[e] > 0)
            flow += p->natural[e] * (1 + p->blown[e] * outside[FAN]) * bent(apart);
        heat[a] -= flow;
        heat[b] += flow;
    }
    for (h = 0; h < (int)p->heaters; h++)
        heat[(int)p->heats[h]] += watt[h];
    for (l = 0; l < (int)p->lines; l++) {
        int b = (int)p->downstream[l];
        heat[b] += p->carried[l] * outside[FLOW] * (arriving[l] - degC[b]);
    }
}

/* The same at rest: what arrives is as warm as what leaves */
void thermal_balance(const thermal_parts *p, const double *degC, const double *watt, const double *outside,
                     double *heat)
{
    double arriving[LINES] = {0};
    int l;
    for (l = 0; l < (int)p->lines; l++)
        arriving[l] = degC[(int)p->upstream[l]];
    heat_into(p, degC, arriving, watt, outside, heat);
}

/* Mean power in W over a substep, by pulse width: a duty holds for a whole period */
static double power(thermal_state *s, const thermal_parts *p, int h, double percent, double dt)
{
    double begin = s->pulse[h], on;
    if (begin >= p->period_s[h] - 1e-9) {
        double duty = rint(fmin(fmax(percent, 0), 100) / 100 * p->levels[h]) / p->levels[h];
        s->on_s[h] = duty * p->period_s[h];
        if (s->on_s[h] < p->shortest_s[h])
            s->on_s[h] = 0;
        if (p->period_s[h] - s->on_s[h] < p->shortest_s[h])
            s->on_s[h] = p->period_s[h];
        begin = 0;
    }
    on = fmin(fmax(s->on_s[h] - begin, 0), dt);
    s->pulse[h] = begin + dt;
    return p->power[h] * on / dt;
}

static void move_lines(thermal_state *s, const thermal_parts *p, double flow, double dt)
{
    int l, k;
    for (l = 0; l < (int)p->lines; l++) {
        s->moved[l] += flow * dt;
        while (s->moved[l] >= p->by_cell[l]) {
            s->moved[l] -= p->by_cell[l];
            for (k = (int)p->cells[l] - 1; k > 0; k--)
                s->line[l][k] = s->line[l][k - 1];
            s->line[l][0] = s->degC[(int)p->upstream[l]];
        }
    }
}

void thermal_advance(thermal_state *s, const thermal_parts *p, const double *u, const double *outside)
{
    double dt = p->sample_s / p->substeps, watt[HEATERS], arriving[LINES] = {0}, heat[NODES];
    int t, i, h, j, l;
    for (t = 0; t < (int)p->substeps; t++) {
        for (h = 0; h < (int)p->heaters; h++)
            watt[h] = power(s, p, h, u[h], dt);
        for (l = 0; l < (int)p->lines; l++)
            arriving[l] = s->line[l][(int)p->cells[l] - 1];
        heat_into(p, s->degC, arriving, watt, outside, heat);
        for (j = 0; j < (int)p->sensors; j++)
            s->sensor[j] += dt * (s->degC[(int)p->senses[j]] - s->sensor[j]) / p->lag_s[j];
        for (i = 0; i < (int)p->nodes; i++)
            s->degC[i] += dt * heat[i] / p->capacity[i];
        move_lines(s, p, outside[FLOW], dt);
    }
}

/* ---- who drives it in a record */

/* A PID without a bump at its limits: the sum stands while the duty is cut, the slope is filtered */
void thermal_control(thermal_pid *c, const thermal_parts *p, const double *r, const double *y, double *u)
{
    int h;
    for (h = 0; h < (int)p->heaters; h++) {
        double error = r[h] - y[h], slope = c->begun > 0 ? (y[h] - c->last[h]) / p->sample_s : 0.0, wanted;
        c->slope[h] += 0.2 * (slope - c->slope[h]);
        c->last[h] = y[h];
        wanted = c->proportional[h] * error + c->sum[h] - c->derivative[h] * c->slope[h];
        u[h] = fmin(fmax(wanted, 0), 100);
        if ((wanted > 0 || error > 0) && (wanted < 100 || error < 0))
            c->sum[h] = fmin(fmax(c->sum[h] + c->integral[h] * p->sample_s * error, 0), 100);
    }
    c->begun = 1;
}

/* Steps by hand: u (steps, heaters) is what the person wants, and becomes what acted. Past `guard` the person
 * shuts a heater off until it is 10 degC below. y (steps, sensors). */
void thermal_by_hand(thermal_state *s, const thermal_parts *p, int steps, double *u, const double *outside,
                     const double *guard, double *y)
{
    int k, h, m = (int)p->heaters, n = (int)p->sensors, shut[HEATERS] = {0};
    for (k = 0; k < steps; k++) {
        thermal_read(s, p, y + k * n);
        for (h = 0; h < m; h++) {
            shut[h] = y[k * n + h] > guard[h] - 10.0 * shut[h];
            if (shut[h])
                u[k * m + h] = 0;
        }
        thermal_advance(s, p, u + k * m, outside + k * OUTSIDE);
    }
}

/* The person's PID under set-points r (steps, heaters) */
void thermal_by_pid(thermal_state *s, const thermal_parts *p, thermal_pid *c, int steps, const double *r,
                    const double *outside, double *u, double *y)
{
    int k, m = (int)p->heaters, n = (int)p->sensors;
    for (k = 0; k < steps; k++) {
        thermal_read(s, p, y + k * n);
        thermal_control(c, p, r + k * m, y + k * n, u + k * m);
        thermal_advance(s, p, u + k * m, outside + k * OUTSIDE);
    }
}
