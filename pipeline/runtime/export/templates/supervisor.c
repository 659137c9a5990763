/* ---- the observer of the model: innovations, and what the plant's spread explains of them */

/* No suspicion: sums and bank begin anew */
static void rest_observer(innovation_memory *o)
{
    memset(o->sums, 0, sizeof o->sums);
    o->age = -1;
    o->ahead = 0;
}

static void start_observer(innovation_memory *o, const double *y)
{
    memcpy(o->x, watch_start_0, sizeof o->x);
    add_product(o->x, watch_start[0], y, WATCH, OUTPUTS);
    memset(o->X, 0, sizeof o->X);
    rest_observer(o);
}

/* after = (A - L C) before, for `columns` columns side by side */
static void through_observer(double *after, const double *before, int columns)
{
    int i, j, k;
    double sees[OUTPUTS];
    for (k = 0; k < columns; k++) {
        for (j = 0; j < OUTPUTS; j++)
            for (i = 0, sees[j] = 0.0; i < WATCH; i++)
                sees[j] += watch_C[j][i] * before[i * columns + k];
        for (i = 0; i < WATCH; i++)
            after[i * columns + k] = -dot(watch_L[i], sees, OUTPUTS);
    }
    for (i = 0; i < WATCH; i++)
        for (j = 0; j < WATCH; j++)
            for (k = 0; k < columns && watch_A[i][j] != 0; k++)
                after[i * columns + k] += watch_A[i][j] * before[j * columns + k];
}

/* x and X a sample on: inputs u acted since the sample whose innovation was e; `moved` is how far the outputs
 * should have moved */
static void advance(innovation_memory *o, const double *u, const double *e, double *moved)
{
    double on[WATCH], y[OUTPUTS], X[WATCH][THETA], change[INPUTS];
    int i, j;
    memcpy(on, watch_b, sizeof on);
    add_product(on, watch_A[0], o->x, WATCH, WATCH);
    add_product(on, watch_B[0], u, WATCH, INPUTS);
    memcpy(y, watch_d, sizeof y);
    add_product(y, watch_C[0], o->x, OUTPUTS, WATCH);
    for (j = 0; j < INPUTS; j++)
        change[j] = o->u[1][j] - u[j];
    through_observer(X[0], o->X[0], THETA);
    for (i = 0; i < WATCH; i++) {
        for (j = 0; j < INPUTS; j++)
            X[i][j] += watch_B[i][j] * u[j];
        X[i][INPUTS] += dot(watch_B[i], change, INPUTS);
        X[i][INPUTS + 1] += o->x[i] - on[i];
        X[i][INPUTS + 2] -= dot(watch_start[i], y, OUTPUTS);
    }
    memcpy(o->X, X, sizeof X);
    memcpy(o->x, on, sizeof on);
    add_product(o->x, watch_L[0], e, WATCH, OUTPUTS);
    memcpy(o->u[0], o->u[1], sizeof o->u[0]);
    memcpy(o->u[1], u, sizeof o->u[1]);
    for (j = 0; j < OUTPUTS; j++)
        moved[j] = dot(watch_C[j], on, WATCH) + watch_d[j] - y[j];
}

/* e in degC; z in deviations, of what no plant of the spread explains; sd in degC; expected the forecast;
 * the highest of all sums */
typedef struct {
    double e[OUTPUTS], z[OUTPUTS], sd[OUTPUTS], expected[OUTPUTS], highest;
} innovation;

static double largest(const double *values, int count)
{
    double most = -INFINITY;
    int i;
    for (i = 0; i < count; i++)
        most = fmax(most, values[i]);
    return most;
}

/* theta and P after innovations v of a variance: recursive least squares, which forgets */
static void learn(innovation_memory *o, double PS[OUTPUTS][THETA], const double *v, const double *variance)
{
    double kept = (1 - KEPT) * (1 - KEPT);
    int i, j, k;
    for (j = 0; j < OUTPUTS; j++)
        for (i = 0; i < THETA; i++) {
            o->theta[j][i] = (o->theta[j][i] + PS[j][i] * (v[j] / variance[j])) * (1 - KEPT);
            for (k = 0; k < THETA; k++)
                o->P[j][i][k] = (o->P[j][i][k] - PS[j][i] * (PS[j][k] / variance[j])) * kept;
            o->P[j][i][i] += (1 - kept) * (watch_prior[i] * watch_prior[i]);
        }
}

static void see(innovation_memory *o, const double *y, const double *trusted, innovation *now)
{
    double S[OUTPUTS][THETA] = {{0}}, PS[OUTPUTS][THETA] = {{0}}, stirred[OUTPUTS] = {0};
    double v[OUTPUTS], variance[OUTPUTS], forgets;
    int i, j, k, telling;
    for (j = 0; j < OUTPUTS; j++) {
        double expected = dot(watch_C[j], o->x, WATCH) + watch_d[j], told;
        for (i = 0; i < WATCH; i++)
            for (k = 0; k < THETA; k++)
                S[j][k] += watch_C[j][i] * o->X[i][k];
        for (k = 0; k < THETA; k++)
            stirred[j] += S[j][k] * watch_prior[k] * (S[j][k] * watch_prior[k]);
        told = dot(S[j], o->theta[j], THETA);
        now->e[j] = trusted[j] > 0 ? y[j] - expected : 0.0;
        now->expected[j] = expected + told;
        v[j] = now->e[j] - trusted[j] * told;
    }
    /* what moves no output leaves nothing open, and teaches nothing about the plant */
    telling = largest(stirred, OUTPUTS) > TELLS * WATCH_LEAST;
    for (j = 0; j < OUTPUTS; j++) {
        variance[j] = watch_floor[j];
        if (telling) {
            add_product(PS[j], o->P[j][0], S[j], THETA, THETA);
            variance[j] += UNEXPLAINED_BY_THETA * UNEXPLAINED_BY_THETA * stirred[j] + dot(S[j], PS[j], THETA);
        }
        now->sd[j] = sqrt(variance[j]);
        now->z[j] = v[j] / now->sd[j];
        forgets = telling ? CALM + STIRRED * (1 - watch_floor[j] / variance[j]) : CALM;
        o->sums[0][j] = fmax(o->sums[0][j] + (fmin(now->z[j], MOST_Z) - forgets), 0.0);
        o->sums[1][j] = fmax(o->sums[1][j] - (fmax(now->z[j], -MOST_Z) + forgets), 0.0);
    }
    now->highest = largest(o->sums[0], 2 * OUTPUTS);
    if (telling && now->highest < DOUBTED)
        learn(o, PS, v, variance);
}

static void push_row(double *ring, const double *row, int length)
{
    memmove(ring, ring + length, (RING - 1) * length * sizeof *ring);
    memcpy(ring + (RING - 1) * length, row, length * sizeof *ring);
}

static void keep(innovation_memory *o, const innovation *now, const double *dy)
{
    double before[2 * INPUTS];
    memcpy(before, o->u[1], sizeof o->u[1]);
    memcpy(before + INPUTS, o->u[0], sizeof o->u[0]);
    push_row(o->z[0], now->z, OUTPUTS);
    push_row(o->sd[0], now->sd, OUTPUTS);
    push_row(o->dy[0], dy, OUTPUTS);
    push_row(o->before[0], before, 2 * INPUTS);
}

/* ---- the bank: every fault followed from around the first odd innovation, with its likeliest amplitude */

static void begin_bank(innovation_memory *o)
{
    double certainty = 0.0, late = 0.0;
    int i, j;
    o->age = 0;
    o->ahead = LONGEST_BACK + 1;
    memcpy(o->u0, o->before[RING - 1 - LONGEST_BACK], sizeof o->u0);
    memset(o->Xb, 0, sizeof o->Xb);
    memset(o->f, 0, sizeof o->f);
    memset(o->cross, 0, sizeof o->cross);
    memset(o->square, 0, sizeof o->square);
    memset(o->own, 0, sizeof o->own);
    for (j = 0; j < OUTPUTS; j++) {
        certainty += 1 / o->P[j][INPUTS][INPUTS];
        late += o->theta[j][INPUTS] * (1 / o->P[j][INPUTS][INPUTS]);
    }
    o->late = cut(late / certainty, 0.0, 1.0);
    for (i = 0; i < INPUTS; i++)
        o->gain[i] = 1 + o->theta[watch_strongest[i]][i];
}

/* How far each input is off under hypothesis h, as a share of its amplitude; u are the inputs told */
static void inputs_off(const innovation_memory *o, int h, const double *u, double *off)
{
    int i;
    memset(off, 0, INPUTS * sizeof *off);
    if (bank_form[h] == FORM_NOT_APPLIED)
        for (i = 0; i < INPUTS; i++)
            off[i] = o->gain[i] * (o->u0[i] - u[i]);
    else if (bank_form[h] < FORM_NOT_APPLIED) {
        i = bank_signal[h];
        off[i] = (bank_form[h] == FORM_ON ? watch_high[i] - u[i] : -(u[i] - watch_low[i])) * o->gain[i];
    }
}

/* How far an output should have moved, as late as the plant is */
static double lagged_move(const innovation_memory *o, int row, int j)
{
    return (1 - o->late) * o->dy[row][j] + o->late * o->dy[row > 0 ? row - 1 : RING - 1][j];
}

/* One row of the ring: Xb of every hypothesis a sample on, and its sums */
static void take_row(innovation_memory *o)
{
    static const double none[INPUTS] = {0};
    double u[INPUTS], off[INPUTS], z[OUTPUTS], (*Xb)[BANK] = o->next;
    int i, j, h, row = RING - o->ahead, since = o->age - LONGEST_BACK;
    for (i = 0; i < INPUTS; i++)
        u[i] = (1 - o->late) * o->before[row][i] + o->late * o->before[row][INPUTS + i];
    through_observer(Xb[0], o->Xb[0], BANK);
    for (h = 0; h < BANK; h++) {
        int sensor = bank_form[h] >= FORM_STEP ? bank_signal[h] : -1;
        memcpy(off, none, sizeof off);
        if (sensor < 0)
            inputs_off(o, h, u, off);
        for (i = 0; i < WATCH && since - 1 >= -bank_back[h]; i++)
            Xb[i][h] += sensor < 0 ? dot(watch_B[i], off, INPUTS) : -watch_L[i][sensor] * o->f[h];
        if (sensor >= 0) {
            double after = bank_form[h] == FORM_RAMP ? since + bank_back[h] : 1.0;
            if (bank_form[h] == FORM_LAG)
                after = bank_lag[h] * (o->f[h] - lagged_move(o, row, sensor));
            o->f[h] = since >= -bank_back[h] ? after : 0.0;
        }
    }
    memcpy(o->Xb, o->next, sizeof o->Xb);
    for (j = 0; j < OUTPUTS; j++)
        z[j] = cut(o->z[row][j], -MOST_Z, MOST_Z);
    for (h = 0; h < BANK; h++)
        for (j = 0; j < OUTPUTS; j++) {
            double s = bank_form[h] >= FORM_STEP && bank_signal[h] == j ? o->f[h] : 0.0, seen = 0.0;
            for (i = 0; i < WATCH; i++)
                seen += watch_C[j][i] * Xb[i][h];
            s = (seen + s) / o->sd[row][j];
            o->cross[h][j] += s * z[j];
            o->square[h][j] += s * s;
        }
    for (j = 0; j < OUTPUTS; j++)
        o->own[j] += z[j] * z[j];
    o->age++;
    o->ahead--;
}

/* Starts the bank where an innovation is odd, ends it where no sum is left and nothing alarms, and takes the
 * newest rows */
static void suspect(innovation_memory *o, const innovation *now, int alarmed)
{
    double odd = now->highest;
    int j, rows;
    for (j = 0; j < OUTPUTS; j++)
        odd = fmax(odd, fabs(now->z[j]));
    if (o->age < 0) {
        if (now->highest > 0 && odd > ODD)
            begin_bank(o);
    } else if (!alarmed && !(now->highest > 0)) {
        o->age = -1;
        o->ahead = 0;
    } else {
        o->ahead++;
    }
    for (rows = o->ahead < CATCH_UP ? o->ahead : CATCH_UP; rows > 0; rows--)
        take_row(o);
}

/* What the bank says: cost and amplitude of every hypothesis; mean squares that the best leaves, and that
 * there were */
typedef struct {
    double cost[BANK], amplitude[BANK], none, left[OUTPUTS], own[OUTPUTS];
    int best;
} verdict;

/* Whether a sensor's lag would show: an offset seldom begins just where its zone moves */
static int moving(const innovation_memory *o, int signal)
{
    int h, j;
    for (h = 0; h < BANK; h++) {
        double square = 0.0;
        for (j = 0; j < OUTPUTS; j++)
            square += o->square[h][j];
        if (bank_form[h] == FORM_LAG && bank_signal[h] == signal && square > MOVING)
            return 1;
    }
    return 0;
}

static double left_by(const innovation_memory *o, int h, int j, double a, int n)
{
    return fmax((o->own[j] - 2 * a * o->cross[h][j] + a * a * o->square[h][j]) / n, 0.0);
}

static void judge(const innovation_memory *o, verdict *v)
{
    int h, j, n = o->age > 1 ? o->age : 1;
    v->none = 0.0;
    v->best = 0;
    for (j = 0; j < OUTPUTS; j++) {
        v->own[j] = o->own[j] / n;
        v->none += n * log(fmax(v->own[j], 1 + MISFIT * v->own[j]));
    }
    for (h = 0; h < BANK; h++) {
        double cross = 0.0, square = 0.0;
        for (j = 0; j < OUTPUTS; j++) {
            cross += o->cross[h][j];
            square += o->square[h][j];
        }
        v->amplitude[h] = cut(cross / fmax(square, 1e-9), bank_least[bank_form[h]], bank_most[bank_form[h]]);
        v->cost[h] = 0.0;
        for (j = 0; j < OUTPUTS; j++)
            v->cost[h] += n * log(fmax(left_by(o, h, j, v->amplitude[h], n), 1 + MISFIT * v->own[j]));
        if ((bank_form[h] == FORM_STEP || bank_form[h] == FORM_RAMP) && moving(o, bank_signal[h]))
            v->cost[h] += COINCIDENCE;
        if (bank_form[h] == FORM_RAMP)
            v->cost[h] += SELDOM;
        if (v->cost[h] < v->cost[v->best])
            v->best = h;
    }
    for (j = 0; j < OUTPUTS; j++)
        v->left[j] = left_by(o, v->best, j, v->amplitude[v->best], n);
}

/* ---- causes */

/* Of two modes the more severe wins: off, then hold, then PI */
static const int severity[4] = {0, 2, 1, 3};


static const char *const reasons[KINDS] = {
    "a heater heats whatever it is told, or goes on with an older command: only the mains can stop it, "
    "switch them off",
    "a heater does not heat whatever it is told, or goes on with an older command: its zone cools",
    "a heater does less than it is told: it lacks power, goes on with an older command, or its zone loses "
    "more heat than the model knows",
    "a zone reads ever colder than heat can explain: its sensor is out of place, or it is not heated",
    "a sensor reads outside its declared limits",
    "a sensor gives no number",
    "a sensor has read the same for longer than chance allows",
    "a sensor is off, or its zone gains or loses heat that no input explains",
    "a sensor follows late, or its zone has become slower",
    "a sensor is noisier than it was",
    "an input was not applied as it was told",
    "the clock jumped between two samples",
    "a sample came late",
    "the readings are not what any plant of the spread would show, and no single fault explains them",
    "a reference is beyond what its limits and the inputs can hold: the last one in reach stays",
};

/* The cause is there now; what was said of it first stays */
static void say(supervisor_kept *k, int kind, int signal, double amount, int other)
{
    if (k->since[kind][signal] < 0) {
        k->since[kind][signal] = k->clock_s[1];
        k->amount[kind][signal] = amount;
        k->other[kind][signal] = other;
        k->active++;
    }
    k->last[kind][signal] = k->clock_s[1];
}

/* Whole samples since the last one, by which the supervisor's own time goes on */
static int tell_time(supervisor_kept *k, double t_s)
{
    double gap_s = t_s - k->clock_s[0], gap = gap_s / BEADLINE_SAMPLE_TIME_S;
    int sane = EARLY <= gap && gap <= JUMP;
    k->clock_s[0] = t_s;
    k->clock_s[1] += sane ? gap_s : BEADLINE_SAMPLE_TIME_S;
    if (!sane)
        say(k, CLOCK_JUMP, 0, gap_s, -1);
    else if (gap > LATE)
        say(k, DEADLINE_MISSED, 0, gap_s, -1);
    return sane && gap > LATE ? (int)(gap + 0.5) : 1;
}

/* Inputs that acted since the last sample, as far as is known */
static void find_acted(supervisor_kept *k, const double *applied, double *u)
{
    int i, wrong = 0, which = 0;
    for (i = 0; i < INPUTS; i++) {
        u[i] = applied && isfinite(applied[i]) ? applied[i] : k->asked[i];
        if (applied && !(fabs(applied[i] - k->asked[i]) <= APPLIED * (watch_high[i] - watch_low[i]))) {
            wrong++;
            which = i;
        }
        u[i] = k->stuck[i] > 0 ? watch_high[i] : u[i] * (1 - k->lacks[i]);
    }
    if (wrong > 1)
        say(k, COMMAND_NOT_APPLIED, 0, 0.0, ALL_INPUTS);
    else if (wrong)
        say(k, COMMAND_NOT_APPLIED, which, applied[which], -1);
}

static double same_by_chance(double quantum, double noise)
{
    return erf(fmin(quantum, 1e9) / (2 * sqrt(2.0) * noise));
}

static double repeats_at_most(double quantum, double noise)
{
    double same = same_by_chance(quantum, noise);
    return same >= 1 ? INFINITY : fmax(REPEATS_LEAST, log(CHANCE) / log(fmax(same, 1e-12)));
}

/* Readings that are none, out of range, or the same for too long */
static void read_sensors(supervisor_kept *k, const double *y)
{
    int j;
    for (j = 0; j < OUTPUTS; j++) {
        double move;
        if (!isfinite(y[j])) {
            say(k, SENSOR_NAN, j, 0.0, -1);
            k->repeats[j] = 0;
            continue;
        }
        if (!(supervisor_low[j] <= y[j] && y[j] <= supervisor_high[j]))
            say(k, OUT_OF_RANGE, j, y[j], -1);
        move = fabs(y[j] - k->y[j]);
        if (move == 0) {
            k->repeats[j]++;
            if (k->samples > 20 && k->repeats[j] >= repeats_at_most(k->quantum[j], supervisor_noise[j]))
                say(k, SENSOR_FROZEN, j, y[j], -1);
        } else {
            if (move > 1e-9)
                k->quantum[j] = fmin(k->quantum[j], move);
            k->repeats[j] = 0;
        }
        k->y[j] = y[j];
    }
}

/* verify_heater of Klipper: an output colder than its target must gain degrees in time */
static void verify_heaters(supervisor_kept *k, const double *y, const double *y_star)
{
    int j;
    for (j = 0; j < OUTPUTS; j++) {
        double below = y_star[j] - supervisor_hysteresis[j] - y[j];
        if (!(below > 0) || !(k->trusted[j] > 0)) {
            k->error[j] = k->waited[j] = 0.0;
            continue;
        }
        if (!(k->waited[j] > 0) || y[j] >= k->goal[j]) {
            k->goal[j] = y[j] + supervisor_gain[j];
            k->waited[j] = k->error[j] = 0.0;
        }
        k->waited[j] += BEADLINE_SAMPLE_TIME_S;
        if (k->waited[j] > supervisor_check_s[j]) {
            k->error[j] += below * BEADLINE_SAMPLE_TIME_S;
            if (k->error[j] > supervisor_error_degC_s[j])
                say(k, THERMAL_RUNAWAY, j, below, -1);
        }
    }
}

/* The kind of a hypothesis at its amplitude */
static int kind_of(const supervisor_kept *k, int h, double amplitude)
{
    int j = bank_signal[h] < OUTPUTS ? bank_signal[h] : OUTPUTS - 1;
    switch (bank_form[h]) {
    case FORM_ON:
        return HEATER_STUCK_ON;
    case FORM_LESS:
        return amplitude > DEAD_SHARE ? HEATER_STUCK_OFF : HEATER_WEAK;
    case FORM_NOT_APPLIED:
        return COMMAND_NOT_APPLIED;
    case FORM_LAG:
        return SENSOR_SLOW;
    case FORM_RAMP:
        if (-amplitude > 2 * dot(supervisor_peak[j], k->held, INPUTS) + 10 * supervisor_noise[j])
            return THERMAL_RUNAWAY;
        return SENSOR_OFFSET;
    default:
        return SENSOR_OFFSET;
    }
}

/* The cause, and the observer freed of what it did to it */
static void explain(supervisor_kept *k, innovation_memory *o, int h, int kind, double amount, int other)
{
    int i, signal = bank_signal[h];
    for (i = 0; i < WATCH; i++)
        o->x[i] += amount * o->Xb[i][h];
    if ((kind == SENSOR_OFFSET || kind == THERMAL_RUNAWAY) && k->since[OUT_OF_RANGE][signal] >= 0) {
        k->absurd[signal] = 1.0;
        return;
    }
    if (kind == COMMAND_NOT_APPLIED)
        other = ALL_INPUTS;
    say(k, kind, signal, kind == SENSOR_OFFSET ? amount * o->f[h] : amount, other);
    if (kind == HEATER_STUCK_ON)
        k->stuck[signal] = 1.0;
    else if (kind == HEATER_STUCK_OFF || kind == HEATER_WEAK)
        k->lacks[signal] = fmin(amount, 1.0);
}

/* From the alarm on: whether it is decided what explains the innovation */
static int diagnose(supervisor_kept *k, innovation_memory *o)
{
    verdict v;
    int h, j, kind, rival = 0, explains, worst = 0, spoilt = 0;
    double rival_cost = INFINITY, clear;
    if (k->alarmed < DECIDED_AFTER || o->ahead > 0 || o->age < 0)
        return 0;
    judge(o, &v);
    kind = kind_of(k, v.best, v.amplitude[v.best]);
    for (h = 0; h < BANK; h++) {
        int same = kind_of(k, h, v.amplitude[h]) == kind && bank_signal[h] == bank_signal[v.best];
        if (!same && v.cost[h] < rival_cost) {
            rival_cost = v.cost[h];
            rival = h;
        }
    }
    clear = v.cost[rival] - v.cost[v.best];
    explains = v.none - v.cost[v.best] > TOLD_APART;
    if (k->alarmed < DECIDED_BY && !(clear > TOLD_APART && explains))
        return 0;
    for (j = 0; j < OUTPUTS; j++) {
        if (v.own[j] > v.own[worst])
            worst = j;
        spoilt |= v.left[j] > UNEXPLAINED && v.left[j] > UNEXPLAINED_SHARE * v.own[j];
    }
    if (k->repeats[worst] >= 2
        && pow(same_by_chance(k->quantum[worst], supervisor_noise[worst]), k->repeats[worst]) < 1e-4)
        say(k, SENSOR_FROZEN, worst, k->y[worst], -1);
    else if (k->square[worst] > NOISY_SQUARE && k->lag[worst] < NOISY_LAG * k->square[worst]
             && (!explains || spoilt))
        say(k, SENSOR_NOISY, worst, sqrt(k->square[worst]), -1);
    else if (!explains || spoilt)
        say(k, MODEL_NO_LONGER_RIGHT, 0, sqrt(v.own[worst]), -1);
    else
        explain(k, o, v.best, kind, v.amplitude[v.best],
                clear <= TOLD_APART ? kind_of(k, rival, v.amplitude[rival]) : -1);
    return 1;
}

/* Sensors that do not count now */
static void distrust(supervisor_kept *k, const double *y)
{
    int j;
    for (j = 0; j < OUTPUTS; j++)
        k->trusted[j] = 1.0;
    for (j = 0; j < OUTPUTS && k->active; j++) {
        double off = fabs(y[j] - k->expected[j]);
        int bad = k->since[SENSOR_NAN][j] >= 0 || k->since[SENSOR_FROZEN][j] >= 0
                  || k->since[SENSOR_SLOW][j] >= 0 || k->since[SENSOR_OFFSET][j] >= 0 || k->absurd[j] > 0
                  || k->since[THERMAL_RUNAWAY][j] >= 0 || k->since[SENSOR_NOISY][j] >= 0 || !isfinite(y[j]);
        k->trusted[j] = bad ? 0.0 : 1.0;
        if (k->since[SENSOR_OFFSET][j] >= 0 && !(off < 0.5 * fabs(k->amount[SENSOR_OFFSET][j])))
            k->last[SENSOR_OFFSET][j] = k->clock_s[1];
        if (k->since[SENSOR_NOISY][j] >= 0 && off > 5 * supervisor_noise[j])
            k->last[SENSOR_NOISY][j] = k->clock_s[1];
    }
}

static int of_output(int kind)
{
    return kind >= THERMAL_RUNAWAY && kind <= SENSOR_NOISY;
}

/* Forgets causes that were not there for their time; whether one of a sensor went */
static int forget(supervisor_kept *k)
{
    int kind, signal, j, sensor = 0;
    for (j = 0; j < OUTPUTS && k->active; j++)
        if (!(k->since[OUT_OF_RANGE][j] >= 0))
            k->absurd[j] = 0.0;
    for (kind = 0; kind < KINDS; kind++)
        for (signal = 0; signal < SIGNALS; signal++)
            if (k->since[kind][signal] >= 0
                && k->clock_s[1] - k->last[kind][signal] > supervisor_back_s[kind]) {
                k->since[kind][signal] = k->last[kind][signal] = -1.0;
                k->other[kind][signal] = -1;
                k->active--;
                sensor |= of_output(kind);
            }
    return sensor;
}

/* The most severe of the modes that the causes declare, and of those that would show the same; hold while an
 * alarm is not decided */
static int find_mode(const supervisor_kept *k)
{
    int kind, signal, worst = MODE_LAW;
    for (kind = 0; kind < KINDS; kind++)
        for (signal = 0; signal < SIGNALS; signal++) {
            int other = k->other[kind][signal];
            if (!(k->since[kind][signal] >= 0))
                continue;
            if (severity[supervisor_mode[kind]] > severity[worst])
                worst = supervisor_mode[kind];
            if (other >= 0 && severity[supervisor_mode[other]] > severity[worst])
                worst = supervisor_mode[other];
        }
    return k->alarmed >= 0 && severity[worst] < severity[MODE_HOLD] ? MODE_HOLD : worst;
}

/* The output whose sum is largest */
static int loudest(const innovation_memory *o)
{
    int j, most = 0;
    for (j = 1; j < OUTPUTS; j++)
        if (fmax(o->sums[0][j], o->sums[1][j]) > fmax(o->sums[0][most], o->sums[1][most]))
            most = j;
    return most;
}

/* The alarm, and its end where it is decided, or where the sensor that raised it is seen to be wrong */
static void raise_alarm(supervisor_kept *k, innovation_memory *o, double highest)
{
    if (k->alarmed < 0) {
        if (highest > ALARM)
            k->alarmed = 0;
        return;
    }
    k->alarmed++;
    if (diagnose(k, o) || k->alarmed > 2 * DECIDED_BY || !(k->trusted[loudest(o)] > 0)) {
        k->alarmed = -1;
        rest_observer(o);
    }
}

static void remember_drift(supervisor_kept *k, const innovation_memory *o)
{
    int j;
    for (j = 0; j < OUTPUTS; j++) {
        k->drift[j][0] = o->x[WATCH - OUTPUTS + j];
        memcpy(k->drift[j] + 1, o->X[WATCH - OUTPUTS + j], sizeof o->X[0]);
    }
}

/* An output that drifts by more than the heat that surroundings may take or give, while nothing else is odd;
 * what a plant of the spread may do does not count */
static void tell_heat(supervisor_kept *k, innovation_memory *o)
{
    int i, j, told = 0, at = WATCH - OUTPUTS;
    double away[OUTPUTS][1 + THETA];
    for (j = 0; j < OUTPUTS; j++) {
        for (i = 0; i <= THETA; i++)
            away[j][i] = (i ? o->X[at + j][i - 1] : o->x[at + j]) - k->drift[j][i];
        told |= !k->active && k->alarmed < 0 && fabs(away[j][0]) > supervisor_heat[j];
    }
    for (j = 0; j < OUTPUTS && told; j++) {
        const double *X = away[j] + 1;
        double off = away[j][0] + dot(X, o->theta[j], THETA), stirred = 0.0, PX[THETA] = {0}, left;
        for (i = 0; i < THETA; i++)
            stirred += X[i] * watch_prior[i] * (X[i] * watch_prior[i]);
        add_product(PX, o->P[j][0], X, THETA, THETA);
        left = sqrt(UNEXPLAINED_BY_THETA * UNEXPLAINED_BY_THETA * stirred + dot(X, PX, THETA));
        if (fabs(off) > supervisor_heat[j] + LEFT_OPEN * left) {
            say(k, SENSOR_OFFSET, j, off / NOISE_FORGETS, -1);
            o->x[at + j] -= off;
        }
    }
    for (j = 0; j < OUTPUTS; j++)
        for (i = 0; i <= THETA; i++)
            k->drift[j][i] += SLOWLY * away[j][i];
}

/* In manual the drift follows fast, and nothing is learned of the plant */
static void hurry(innovation_memory *o, const double *e)
{
    add_product(o->x, watch_hurried[0], e, WATCH, OUTPUTS);
    memset(o->X, 0, sizeof o->X);
}

/* One sample of outputs y, inputs `applied` since the one before, none of `samples` in manual; filled is y
 * with what is not trusted as forecast */
static void follow(supervisor_kept *k, innovation_memory *o, const double *y, const double *y_star,
                   const double *applied, int samples, double *filled)
{
    double u[INPUTS], start[OUTPUTS], moved[OUTPUTS] = {0};
    static const double none[OUTPUTS] = {0};
    innovation now;
    int j, step, first = k->samples == 0;
    find_acted(k, applied, u);
    read_sensors(k, y);
    if (first) {
        for (j = 0; j < OUTPUTS; j++)
            start[j] = isfinite(y[j]) ? y[j] : y_star[j];
        start_observer(o, start);
        memcpy(o->u[0], u, sizeof u);
        memcpy(o->u[1], u, sizeof u);
        memset(k->drift, 0, sizeof k->drift);
    } else
        for (step = 0; step < (samples > 0 ? samples : 1); step++) {
            advance(o, u, step == 0 ? k->e : none, moved);
            if (samples == 0)
                hurry(o, k->e);
        }
    distrust(k, y);
    see(o, y, k->trusted, &now);
    for (j = 0; j < OUTPUTS; j++) {
        double z = cut(now.z[j], -NOISE_MOST_Z, NOISE_MOST_Z);
        k->square[j] += NOISE_FORGETS * (z * z - k->square[j]);
        k->lag[j] += NOISE_FORGETS * (z * k->z[j] - k->lag[j]);
        k->z[j] = z;
    }
    keep(o, &now, moved);
    suspect(o, &now, k->alarmed >= 0);
    memcpy(k->expected, now.expected, sizeof now.expected);
    memcpy(k->e, now.e, sizeof now.e);
    for (j = 0; j < OUTPUTS; j++)
        filled[j] = k->trusted[j] > 0 ? y[j] : now.expected[j];
    if (samples == 0) {
        rest_observer(o);
        remember_drift(k, o);
    } else {
        raise_alarm(k, o, now.highest);
        tell_heat(k, o);
    }
    if (forget(k)) {
        start_observer(o, filled);
        memset(k->e, 0, sizeof k->e);
        memset(k->drift, 0, sizeof k->drift);
    }
    k->samples++;
}
