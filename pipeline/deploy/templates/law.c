/* ---- the law
 *
 *     u = feed - K z - D y - K_r xi, cut to low..high and to `rate` a sample, then by the governor
 *     xi(t+1) = xi + integral (clip(y* - y) + clip(beyond(P (u - u wished))))
 *     z(t+1) = A z + B_u u + B_y y + B_r r + c
 *
 * The target y* is the reference, or the nearest one that the inputs can hold; feed rests there. What makes up for
 * disturbances, `forward`, is added to u before it is cut; the law remembers u without it.
 */

/* What a law is made of, matrices row after row; tables.h holds them. Letters as above. */
typedef struct {
    int memories;    /* length of z */
    int shift;       /* A moves z on by so many entries; 0: A is a full matrix */
    int conditional; /* conditional integration: aims at the reference itself */
    int integrates, holds, governed;
    real integral_limit; /* degC: largest error and largest shift that xi sees */
    const real *A, *B_u, *B_y, *B_r, *c;
    const real *K, *D, *K_r, *integral, *back; /* back: P */
    const real *start_u, *start_y, *start;
    const real *low, *high, *rate;                /* percent, and percent a sample */
    const real *feed_u, *feed_y, *feed_r, *feed_0; /* feed = feed_u u + feed_y y* + feed_r r + feed_0 */
} law;

#include "tables.h"

/* ---- arithmetic */

static real cut(real value, real low, real high)
{
    return fmin(fmax(value, low), high);
}

/* y += M x, M of `rows` rows and `columns` columns, row after row */
static void add_product(real *y, const real *M, const real *x, int rows, int columns)
{
    int i, j;
    for (i = 0; i < rows; i++) {
        const real *row = M + i * columns;
        real sum = 0;
        for (j = 0; j < columns; j++)
            sum += row[j] * x[j];
        y[i] += sum;
    }
}

static void add(real *y, const real *x, int count)
{
    int i;
    for (i = 0; i < count; i++)
        y[i] += x[i];
}

static real dot(const real *a, const real *b, int count)
{
    real sum = 0;
    int i;
    for (i = 0; i < count; i++)
        sum += a[i] * b[i];
    return sum;
}

static int all_finite(const real *values, int count)
{
    int i;
    for (i = 0; i < count; i++)
        if (!isfinite(values[i]))
            return 0;
    return 1;
}

/* ---- the feasible target: bounded least squares (Stark and Parker 1995)
 *
 * In double precision in either build: a plant that almost integrates rests on outputs 1e5 times as large as those
 * that count. It is found anew only for a new reference. */

#define ROWS (OUTPUTS + INPUTS)

/* z that minimises |A z - b| by Householder reflections; A has `columns` columns and is overwritten, as b */
static void least_squares(double A[ROWS][INPUTS], double *b, int columns, double *z)
{
    int i, j, k;
    for (k = 0; k < columns; k++) {
        double v[ROWS], size = 0, length = 0, sum, diagonal;
        for (i = k; i < ROWS; i++)
            size += A[i][k] * A[i][k];
        diagonal = A[k][k] > 0 ? -sqrt(size) : sqrt(size);
        for (i = k; i < ROWS; i++)
            v[i] = A[i][k] - (i == k ? diagonal : 0);
        for (i = k; i < ROWS; i++)
            length += v[i] * v[i];
        for (j = k + 1; j < columns && length > 0; j++) {
            sum = 0;
            for (i = k; i < ROWS; i++)
                sum += v[i] * A[i][j];
            for (i = k; i < ROWS; i++)
                A[i][j] -= v[i] * (2 * sum / length);
        }
        sum = 0;
        for (i = k; i < ROWS; i++)
            sum += v[i] * b[i];
        for (i = k; i < ROWS && length > 0; i++)
            b[i] -= v[i] * (2 * sum / length);
        A[k][k] = diagonal;
    }
    for (k = columns - 1; k >= 0; k--) {
        z[k] = b[k];
        for (j = k + 1; j < columns; j++)
            z[k] -= A[k][j] * z[j];
        z[k] /= A[k][k];
    }
}

/* A number of the rows: what outputs rest on, then LIGHT for each input, so that of equally good ones the
 * smaller is the target */
static double row_of(int i, int j)
{
    return i < OUTPUTS ? aim_rows[i][j] : i - OUTPUTS == j ? LIGHT : 0;
}

/* One bounded problem: min |rows x - right|^2, low <= x <= high; `at` is -1, 1 where x stands at low, high */
typedef struct {
    double right[ROWS], low[INPUTS], high[INPUTS], x[INPUTS], gain[INPUTS], cost;
    int at[INPUTS];
} bounded;

/* z of the inputs that are free, the others where they stand; `index` tells which; returns how many */
static int solve_free(const bounded *b, double *z, int *index)
{
    double A[ROWS][INPUTS], right[ROWS];
    int i, j, count = 0;
    for (j = 0; j < INPUTS; j++)
        if (!b->at[j])
            index[count++] = j;
    for (i = 0; i < ROWS; i++) {
        right[i] = b->right[i];
        for (j = 0; j < INPUTS; j++)
            if (b->at[j])
                right[i] -= row_of(i, j) * b->x[j];
        for (j = 0; j < count; j++)
            A[i][j] = row_of(i, index[j]);
    }
    least_squares(A, right, count, z);
    return count;
}

/* The cost, and by how much more than rounding it falls where an input leaves the limit it stands at */
static void look(bounded *b)
{
    double miss[ROWS], terms[ROWS];
    int i, j;
    b->cost = 0;
    for (i = 0; i < ROWS; i++) {
        miss[i] = 0;
        terms[i] = fabs(b->right[i]);
        for (j = 0; j < INPUTS; j++) {
            miss[i] += row_of(i, j) * b->x[j];
            terms[i] += fabs(row_of(i, j) * b->x[j]);
        }
        miss[i] -= b->right[i];
        b->cost += 0.5 * miss[i] * miss[i];
    }
    for (j = 0; j < INPUTS; j++) {
        double gradient = 0, doubt = 0;
        for (i = 0; i < ROWS; i++) {
            gradient += row_of(i, j) * miss[i];
            doubt += fabs(row_of(i, j)) * terms[i];
        }
        b->gain[j] = gradient * b->at[j] - ROUNDING * doubt;
    }
}

/* Moves towards z until an input meets a limit, which it then keeps; returns whether one did */
static int move_until_bound(bounded *b, const double *z, const int *index, int count)
{
    double least = INFINITY;
    int k, side, first = -1, bound = 0;
    for (side = -1; side <= 1; side += 2)
        for (k = 0; k < count; k++) {
            int j = index[k], beyond = side < 0 ? z[k] < b->low[j] : z[k] > b->high[j];
            double wall = side < 0 ? b->low[j] : b->high[j];
            if (beyond && (wall - b->x[j]) / (z[k] - b->x[j]) < least) {
                least = (wall - b->x[j]) / (z[k] - b->x[j]);
                first = j;
                bound = side;
            }
        }
    for (k = 0; k < count; k++) {
        int j = index[k];
        b->x[j] = first < 0 ? z[k] : b->x[j] * (1 - least) + least * z[k];
    }
    if (first >= 0)
        b->at[first] = bound;
    return first >= 0;
}

/* The optimum of b, into b->x: least squares of what is free, then inputs set free again one by one */
static void minimise(bounded *b)
{
    double z[INPUTS], before;
    int index[INPUTS], j, k, count, cuts, round, best;
    for (j = 0; j < INPUTS; j++)
        b->at[j] = 0;
    solve_free(b, b->x, index);
    for (j = 0, cuts = 0; j < INPUTS; j++)
        cuts += b->x[j] < b->low[j] || b->x[j] > b->high[j];
    if (!cuts)
        return;
    for (j = 0; j < INPUTS; j++) {
        b->at[j] = b->x[j] <= b->low[j] ? -1 : b->x[j] >= b->high[j] ? 1 : 0;
        b->x[j] = fmin(fmax(b->x[j], b->low[j]), b->high[j]);
    }
    do {
        count = solve_free(b, z, index);
        for (k = 0, cuts = 0; k < count; k++) {
            j = index[k];
            b->at[j] = z[k] < b->low[j] ? -1 : z[k] > b->high[j] ? 1 : 0;
            b->x[j] = fmin(fmax(z[k], b->low[j]), b->high[j]);
            cuts += b->at[j] != 0;
        }
    } while (cuts && count > cuts);
    look(b);
    for (round = 0; round < INPUTS; round++) {
        for (j = 1, best = 0; j < INPUTS; j++)
            if (b->gain[j] > b->gain[best])
                best = j;
        if (b->gain[best] <= 0)
            break;
        b->at[best] = 0;
        do
            count = solve_free(b, z, index);
        while (move_until_bound(b, z, index, count));
        before = b->cost;
        look(b);
        if (before - b->cost < FALL * before)
            break;
    }
}

/* Steady inputs at least `slack` from their limits, and the outputs they hold; returns |y - r| */
static double steady(const law *l, const real *r, double slack, real *u, real *y)
{
    bounded b;
    double miss = 0;
    int i, j;
    for (i = 0; i < OUTPUTS; i++)
        b.right[i] = (double)r[i] - aim_d[i] - aim_rest[i];
    for (j = 0; j < INPUTS; j++) {
        b.right[OUTPUTS + j] = 0;
        b.low[j] = (double)l->low[j] + fmin(slack, AIM_WIDEST);
        b.high[j] = (double)l->high[j] - fmin(slack, AIM_WIDEST);
    }
    minimise(&b);
    for (i = 0; i < OUTPUTS; i++) {
        double rests = 0;
        for (j = 0; j < INPUTS; j++)
            rests += aim_rows[i][j] * b.x[j];
        rests = rests + aim_rest[i] + aim_d[i];
        y[i] = (real)rests;
        miss += (rests - (double)r[i]) * (rests - (double)r[i]);
    }
    for (j = 0; j < INPUTS; j++)
        u[j] = (real)b.x[j];
    return sqrt(miss);
}

/* The target y_star nearest to r that the inputs can hold, and among those the one that keeps them as far
 * from their limits as `AIM_TOLERANCE` degC of reach allow; u holds it */
static void feasible_target(const law *l, const real *r, real *u, real *y_star)
{
    real wider_u[INPUTS], wider_y[OUTPUTS];
    double slack = 0, step = AIM_FIRST;
    double reach = steady(l, r, 0, u, y_star) + AIM_TOLERANCE;
    while (step > AIM_FINEST) {
        double miss = steady(l, r, slack + step, wider_u, wider_y);
        if (slack + step <= AIM_WIDEST && miss <= reach) {
            slack += step;
            memcpy(u, wider_u, sizeof wider_u);
            memcpy(y_star, wider_y, sizeof wider_y);
        } else {
            step /= 2;
        }
    }
}

/* feed of the formula and its target for a constant reference r */
static void aim(const law *l, const real *r, real *feed, real *y_star)
{
    real u[INPUTS];
    feasible_target(l, r, u, y_star);
    if (l->conditional)
        memcpy(y_star, r, OUTPUTS * sizeof *r);
    memcpy(feed, l->feed_0, INPUTS * sizeof *feed);
    add_product(feed, l->feed_u, u, INPUTS, INPUTS);
    add_product(feed, l->feed_y, y_star, INPUTS, OUTPUTS);
    add_product(feed, l->feed_r, r, INPUTS, OUTPUTS);
}

/* ---- the governor: keeps the forecast of a family of plants within the limits of the outputs */

typedef struct {
    real bare[MEMBERS][FORECASTS], strength[MEMBERS][OUTPUTS], wall[MEMBERS][OUTPUTS];
    int counts[MEMBERS];
    const real (*rows)[FORECASTS][INPUTS];
    const real (*least)[FORECASTS];
} side;

typedef struct {
    real least[MEMBERS][OUTPUTS], middle[MEMBERS][OUTPUTS], most[MEMBERS][OUTPUTS];
    int counts[MEMBERS];
} evidence;

static void start_governor(member_state *x, const real *y)
{
    int f;
    memset(x, 0, MEMBERS * sizeof *x);
    for (f = 0; f < MEMBERS; f++) {
        memcpy(x[f].strongest, governor_start_0[f], sizeof x[f].strongest);
        add_product(x[f].strongest, governor_start[f][0], y, WATCHED, OUTPUTS);
    }
}

/* Members at their strongest x, and by how much less at their weakest, once y is measured */
static void correct(member_state *x, const real *y)
{
    int f, i, j;
    for (f = 0; f < MEMBERS; f++) {
        member_state *s = &x[f];
        real e[OUTPUTS], calm[OUTPUTS], lacks[OUTPUTS], lacks_calm[OUTPUTS];
        for (j = 0; j < OUTPUTS; j++) {
            real strength, surprise = governor_surprise[j];
            e[j] = y[j] - governor_offset[f][j] - dot(governor_C[f][j], s->strongest, WATCHED);
            lacks[j] = dot(governor_C[f][j], s->lacks, WATCHED);
            s->sums[0][j] = (1 - FORGETS) * s->sums[0][j] - e[j] * lacks[j];
            s->sums[1][j] = (1 - FORGETS) * s->sums[1][j] + lacks[j] * lacks[j];
            s->sums[2][j] = (1 - FORGETS) * s->sums[2][j] + fabs(lacks[j]);
            s->sums[3][j] = (1 - FORGETS) * s->sums[3][j] + e[j] * e[j];
            strength = cut(s->sums[0][j] / (s->sums[1][j] + REAL(1e-12)), 0, 1);
            calm[j] = cut(e[j] + strength * lacks[j], -surprise, surprise);
            lacks_calm[j] = cut(lacks[j], -surprise, surprise);
        }
        for (i = 0; i < WATCHED; i++) {
            int drift = i >= WATCHED - OUTPUTS;
            s->strongest[i] += dot(governor_L[f][i], drift ? calm : e, OUTPUTS);
            s->lacks[i] -= dot(governor_L[f][i], drift ? lacks_calm : lacks, OUTPUTS);
        }
    }
}

/* Members a sample on, inputs u applied */
static void predict(member_state *x, const real *u)
{
    int f;
    for (f = 0; f < MEMBERS; f++) {
        real strongest[WATCHED], lacks[WATCHED] = {0};
        memcpy(strongest, governor_b[f], sizeof strongest);
        add_product(strongest, governor_A[f][0], x[f].strongest, WATCHED, WATCHED);
        add_product(strongest, governor_B[f][0], u, WATCHED, INPUTS);
        add_product(lacks, governor_A[f][0], x[f].lacks, WATCHED, WATCHED);
        add_product(lacks, governor_B_lacks[f][0], u, WATCHED, INPUTS);
        memcpy(x[f].strongest, strongest, sizeof strongest);
        memcpy(x[f].lacks, lacks, sizeof lacks);
    }
}

/* Between strongest (0) and weakest (1), where the inputs are at least, by least squares, and at most; and
 * which members count */
static void weigh(const member_state *x, evidence *told)
{
    real rest[MEMBERS], best = INFINITY, noise = 0;
    int f, j;
    for (f = 0; f < MEMBERS; f++) {
        rest[f] = 0;
        for (j = 0; j < OUTPUTS; j++) {
            real product = x[f].sums[0][j], square = x[f].sums[1][j];
            real share = 1 / (square + REAL(1e-12)), doubt = governor_doubt[j] * x[f].sums[2][j] + REAL(1e-9);
            real middle = cut(product * share, 0, 1);
            rest[f] += x[f].sums[3][j] - middle * (2 * product - middle * square);
            told->middle[f][j] = middle;
            told->least[f][j] = cut((product - doubt) * share, 0, 1);
            told->most[f][j] = cut((product + doubt) * share, 0, 1);
        }
        best = fmin(best, rest[f]);
    }
    for (j = 0; j < OUTPUTS; j++)
        noise += governor_doubt[j] * governor_doubt[j];
    for (f = 0; f < MEMBERS; f++)
        told->counts[f] = rest[f] <= CONTRADICTED * best + noise;
}

/* Floor and cap of an output that is forecast `now`, where its target is y_star */
static void walls(int j, real now, real y_star, real *floor_at, real *cap_at)
{
    real near = governor_near[j];
    real leaving = -(y_star - now) < ARRIVED * OVERSHOOT ? near : OVERSHOOT;
    real arriving = y_star - now < ARRIVED * OVERSHOOT ? near : OVERSHOOT;
    real low = y_star - leaving, high = y_star + arriving;
    *floor_at = fmax(governor_low[j], now < low - OVERSHOOT ? -INFINITY : low);
    *cap_at = fmin(governor_high[j], now > high + OVERSHOOT ? now : high);
}

static void look_ahead(const member_state *x, const real *y_star, side *below, side *above)
{
    evidence told;
    int f, j, k;
    weigh(x, &told);
    for (f = 0; f < MEMBERS; f++)
        for (j = 0; j < OUTPUTS; j++) {
            real least = told.least[f][j], middle = told.middle[f][j], most = told.most[f][j];
            const real(*ahead)[WATCHED] = &governor_ahead[f][j * INSTANTS];
            real lacks_now = dot(ahead[0], x[f].lacks, WATCHED), floor_at, cap_at;
            real now = dot(ahead[0], x[f].strongest, WATCHED) - middle * lacks_now + governor_offset[f][j];
            walls(j, now, y_star[j], &floor_at, &cap_at);
            for (k = 0; k < INSTANTS; k++) {
                int row = j * INSTANTS + k;
                real bare = dot(ahead[k], x[f].strongest, WATCHED) - middle * lacks_now;
                real lacks = dot(ahead[k], x[f].lacks, WATCHED) - lacks_now;
                below->bare[f][row] = -(bare - most * lacks) - governor_below[f][row];
                above->bare[f][row] = bare - least * lacks + governor_above[f][row];
            }
            below->strength[f][j] = STRONGEST - (STRONGEST - WEAKEST) * most;
            above->strength[f][j] = STRONGEST - (STRONGEST - WEAKEST) * least;
            below->wall[f][j] = -floor_at;
            above->wall[f][j] = cap_at;
        }
    memcpy(below->counts, told.counts, sizeof told.counts);
    memcpy(above->counts, told.counts, sizeof told.counts);
    below->rows = governor_fall;
    below->least = governor_fall_least;
    above->rows = governor_rise;
    above->least = governor_rise_least;
}

/* What of a row lowers the output: an input that hardly moves it is not shut for its sake */
static real helps(const side *s, int f, int row, int i)
{
    real effect = s->rows[f][row][i];
    return effect > s->least[f][row] && effect > 0 ? effect : 0;
}

/* Rows by which an output may rise, each as far as the inputs that help can keep it */
static void find_room(const side *s, const real *u, const real *low, real room[MEMBERS][FORECASTS])
{
    int f, i, row;
    for (f = 0; f < MEMBERS; f++)
        for (row = 0; row < FORECASTS; row++) {
            int j = row / INSTANTS;
            real kept = 0, other = 0;
            for (i = 0; i < INPUTS; i++) {
                kept += low[i] * helps(s, f, row, i);
                other += u[i] * (s->rows[f][row][i] - helps(s, f, row, i));
            }
            room[f][row] = (s->wall[f][j] - s->bare[f][row]) / s->strength[f][j];
            room[f][row] = s->counts[f] ? fmax(room[f][row], kept + other) : INFINITY;
        }
}

/* One projection of u onto the most violated row of output j */
static void project_output(const side *s, real room[MEMBERS][FORECASTS], int j, const real *low,
                           real *u)
{
    real most = -INFINITY, size = 0, direction[INPUTS];
    int f, i, row, worst_f = -1, worst = 0;
    for (f = 0; f < MEMBERS; f++)
        for (row = j * INSTANTS; row < (j + 1) * INSTANTS; row++)
            most = fmax(most, dot(s->rows[f][row], u, INPUTS) - room[f][row]);
    if (!(most > EXACT))
        return;
    for (f = 0; f < MEMBERS && worst_f < 0; f++)
        for (row = j * INSTANTS; row < (j + 1) * INSTANTS && worst_f < 0; row++)
            if (dot(s->rows[f][row], u, INPUTS) - room[f][row] >= most - EXACT) {
                worst_f = f;
                worst = row;
            }
    for (i = 0; i < INPUTS; i++) {
        direction[i] = u[i] > low[i] + EXACT ? helps(s, worst_f, worst, i) : 0;
        size += direction[i] * direction[i];
    }
    for (i = 0; i < INPUTS && size > 0; i++)
        u[i] = fmax(u[i] - most / size * direction[i], low[i]);
}

/* Cuts u until every row is kept as far as the inputs go; returns whether a row touched it */
static int project(const side *s, const real *low, real *u)
{
    real room[MEMBERS][FORECASTS];
    int f, j, row, sweep, touched = 0;
    for (f = 0; f < MEMBERS; f++)
        for (row = 0; row < FORECASTS && s->counts[f]; row++) {
            j = row / INSTANTS;
            if (s->bare[f][row] + s->strength[f][j] * dot(u, s->rows[f][row], INPUTS) > s->wall[f][j])
                touched = 1;
        }
    if (!touched)
        return 0;
    find_room(s, u, low, room);
    for (sweep = 0; sweep < SWEEPS; sweep++) {
        int at_fault[OUTPUTS] = {0}, any = 0;
        for (f = 0; f < MEMBERS; f++)
            for (row = 0; row < FORECASTS; row++)
                if (dot(s->rows[f][row], u, INPUTS) - room[f][row] > EXACT)
                    at_fault[row / INSTANTS] = any = 1;
        for (j = 0; j < OUTPUTS; j++)
            if (at_fault[j])
                project_output(s, room, j, low, u);
        if (!any)
            break;
    }
    return 1;
}

static void negate(real *u)
{
    int i;
    for (i = 0; i < INPUTS; i++)
        u[i] = -u[i];
}

/* u as near to what was asked as the forecasts allow, within low..high; the high limit has the last word */
static void govern(const member_state *x, const real *y_star, const real *low, const real *high,
                   real *u)
{
    side below, above;
    real negative_high[INPUTS];
    int i, raised, lowered, round;
    look_ahead(x, y_star, &below, &above);
    for (i = 0; i < INPUTS; i++)
        negative_high[i] = -high[i];
    negate(u);
    raised = project(&below, negative_high, u);
    negate(u);
    lowered = project(&above, low, u);
    for (round = 0; round < ROUNDS && raised && lowered; round++) {
        negate(u);
        project(&below, negative_high, u);
        negate(u);
        project(&above, low, u);
    }
}

/* ---- a sample at a time */

/* Inputs less what is fed forward */
static void without_forward(const law_state *s, const real *u, real *acts)
{
    int i;
    for (i = 0; i < INPUTS; i++)
        acts[i] = u[i] - s->forward[i];
}

static void remember(const law *l, law_state *s, const real *u, const real *y, const real *r)
{
    real z[MEMORY], acts[INPUTS];
    int i;
    for (i = 0; i < l->memories; i++)
        z[i] = l->c[i];
    without_forward(s, u, acts);
    add_product(z, l->B_u, acts, l->memories, INPUTS);
    add_product(z, l->B_y, y, l->memories, OUTPUTS);
    add_product(z, l->B_r, r, l->memories, OUTPUTS);
    if (l->shift)
        add(z, s->z + l->shift, l->memories - l->shift);
    else
        add_product(z, l->A, s->z, l->memories, l->memories);
    for (i = 0; i < l->memories; i++)
        s->z[i] = z[i];
    for (i = 0; i < INPUTS; i++)
        s->u[i] = u[i];
}

static void law_watch(const law *l, law_state *s, const real *u, const real *y, const real *r)
{
    real acts[INPUTS];
    without_forward(s, u, acts);
    if (!s->seen) {
        int i;
        for (i = 0; i < l->memories; i++)
            s->z[i] = l->start[i];
        add_product(s->z, l->start_u, acts, l->memories, INPUTS);
        add_product(s->z, l->start_y, y, l->memories, OUTPUTS);
        if (l->governed)
            start_governor(s->x, y);
        s->seen = 1;
    }
    if (l->governed) {
        correct(s->x, y);
        predict(s->x, acts);
    }
    remember(l, s, u, y, r);
}

/* u wished at target feed, without xi's part where `xi` is NULL */
static void wish(const law *l, const law_state *s, const real *feed, const real *y, const real *xi,
                 real *u)
{
    real asked[INPUTS] = {0};
    int i;
    add_product(asked, l->K, s->z, INPUTS, l->memories);
    add_product(asked, l->D, y, INPUTS, OUTPUTS);
    if (xi)
        add_product(asked, l->K_r, xi, INPUTS, OUTPUTS);
    for (i = 0; i < INPUTS; i++)
        u[i] = feed[i] - asked[i];
}

static void law_hand_over(const law *l, law_state *s, const real *y)
{
    real feed[INPUTS], y_star[OUTPUTS], shift[INPUTS], acts[INPUTS], most = l->integral_limit;
    int i, j;
    if (l->holds || !l->integrates)
        return;
    aim(l, y, feed, y_star);
    wish(l, s, feed, y, NULL, shift);
    without_forward(s, s->u, acts);
    for (i = 0; i < INPUTS; i++)
        shift[i] = l->conditional ? acts[i] : acts[i] - shift[i];
    for (j = 0; j < OUTPUTS; j++) {
        s->xi[j] = dot(l->back + j * INPUTS, shift, INPUTS);
        if (!l->conditional)
            s->xi[j] = cut(s->xi[j], -most, most);
    }
}

/* xi a sample on where the command is cut: it rests there, and -K_r xi stays within the limits */
static void integrate_conditionally(const law *l, law_state *s, const real *error, const real *u,
                                    const real *wished)
{
    real after[OUTPUTS], share[INPUTS], within;
    int i, j, inside;
    for (j = 0; j < OUTPUTS; j++)
        after[j] = s->xi[j] + l->integral[j] * error[j];
    for (i = 0; i < INPUTS; i++)
        share[i] = cut(-dot(l->K_r + i * OUTPUTS, after, OUTPUTS), l->low[i], l->high[i]);
    for (j = 0; j < OUTPUTS; j++) {
        within = dot(l->back + j * INPUTS, share, INPUTS);
        for (i = 0, inside = 0; i < INPUTS; i++)
            inside |= fabs(u[i] - wished[i]) <= BY_PRECISION(1e-9, 1e-5) * (l->high[i] - l->low[i])
                      && l->K_r[i * OUTPUTS + j] != 0;
        if (inside)
            s->xi[j] = within;
    }
}

static void integrate(const law *l, law_state *s, const real *error, const real *u, const real *wished)
{
    real excess[INPUTS], shift, most = l->integral_limit;
    int i, j;
    if (l->conditional) {
        integrate_conditionally(l, s, error, u, wished);
        return;
    }
    for (i = 0; i < INPUTS; i++)
        excess[i] = u[i] - wished[i];
    for (j = 0; j < OUTPUTS && l->integrates; j++) {
        shift = dot(l->back + j * INPUTS, excess, INPUTS);
        shift -= cut(shift, -most, most);
        s->xi[j] += l->integral[j] * (cut(error[j], -most, most) + cut(shift, -most, most));
    }
}

static void law_step(const law *l, law_state *s, const real *y, const real *r, real *u)
{
    real wished[INPUTS], low[INPUTS], high[INPUTS], error[OUTPUTS], acts[INPUTS];
    int i, j;
    if (!s->aimed || memcmp(s->r, r, sizeof s->r)) {
        aim(l, r, s->feed, s->y_star);
        memcpy(s->r, r, sizeof s->r);
        s->aimed = 1;
    }
    if (l->holds) {
        memcpy(u, s->u, sizeof s->u);
        return;
    }
    wish(l, s, s->feed, y, s->xi, wished);
    for (i = 0; i < INPUTS; i++) {
        low[i] = fmax(l->low[i], fmin(s->u[i] - l->rate[i], l->high[i]));
        high[i] = fmin(l->high[i], fmax(s->u[i] + l->rate[i], l->low[i]));
        u[i] = cut(wished[i] + s->forward[i], low[i], high[i]);
        low[i] -= s->forward[i];
        high[i] -= s->forward[i];
    }
    without_forward(s, u, acts);
    if (l->governed) {
        correct(s->x, y);
        govern(s->x, s->y_star, low, high, acts);
        for (i = 0; i < INPUTS; i++)
            u[i] = acts[i] + s->forward[i];
        without_forward(s, u, acts);
        predict(s->x, acts);
    }
    for (j = 0; j < OUTPUTS; j++)
        error[j] = s->y_star[j] - y[j];
    integrate(l, s, error, acts, wished);
    remember(l, s, u, y, r);
}
