/* ---- the supervisor */

/* Reasons by kind; amounts and signals are in beadline_cause */
static const char *const reasons[KINDS] = {
    "a sensor gives no number, or one outside its limits",
    "a sensor stands still while its model moves: the sensor, or its heater",
    "a sensor shows noise alone while its model moves: the sensor, or its heater",
    "a heater is stuck on: only the mains can stop it",
    "a heater lacks a share of what it is told, or its sensor is out of place",
    "the reference is out of reach: the last one in reach stays"
};

static real largest(real a, real b)
{
    return a > b ? a : b;
}

/* A cause is there now; what was said first of it stays */
static void say(supervisor_kept *k, int kind, int signal, real amount)
{
    if (k->since[kind][signal] < 0) {
        k->since[kind][signal] = k->now;
        k->amount[kind][signal] = amount;
        k->active++;
    }
    k->last[kind][signal] = k->now;
}

static void end_windows(supervisor_kept *k)
{
    int w;
    for (w = 0; w < WINDOWS; w++)
        k->window[w].age = -1;
}

/* Whole samples since the last one; a clock that tells no time between two samples counts as one, and the
 * first time forecasts begin anew */
static int pass_time(supervisor_kept *k, beadline_clock t)
{
    beadline_clock passed;
    real gap;
    int sane;
    if (!k->clocked) {
        k->clock = t - SAMPLE_TIME;
        k->clocked = 1;
    }
    passed = t - k->clock;
    gap = passed / (SECOND * (real)BEADLINE_SAMPLE_TIME_S);
    sane = gap >= EARLY && gap <= JUMP;
    k->clock = t;
    k->now += sane ? passed : SAMPLE_TIME;
    if (!sane && !k->insane)
        end_windows(k);
    k->insane = !sane;
    return sane && gap > REAL(1.5) ? (int)(gap + REAL(0.5)) : 1;
}

/* Steps of a sensor in degC; UNKNOWN_STEP_DEGC as long as they are not known */
static real steps_of(const supervisor_kept *k, int j)
{
    return isfinite(k->quantum[j]) ? k->quantum[j] : UNKNOWN_STEP_DEGC;
}

/* Which outputs count now; says which gives no number, or one out of its range */
static void read_sensors(supervisor_kept *k, const real *y, int *counts)
{
    int j;
    for (j = 0; j < OUTPUTS; j++) {
        int good = isfinite(y[j]) && y[j] >= supervisor_coldest[j] && y[j] <= supervisor_hottest[j];
        k->bad[j] = good ? 0 : k->bad[j] + 1;
        if (k->bad[j] >= REPEATED)
            say(k, SENSOR_OPEN, j, y[j]);
        if (good) {
            real move = fabs(y[j] - k->y[j]);
            if (isinf(k->quantum[j]) && move > MOST_STEP_DEGC)
                k->quantum[j] = NAN; /* perhaps it was switched on */
            else if (move > REAL(1e-9))
                k->quantum[j] = fmin(k->quantum[j], move);
            k->repeats[j] = move < REAL(1e-12) ? k->repeats[j] + 1 : 0;
            k->y[j] = y[j];
        }
        counts[j] = good && k->since[SENSOR_OPEN][j] < 0 && k->since[SENSOR_STILL][j] < 0
                    && k->since[SENSOR_DEAF][j] < 0;
    }
}

static real forecast(const real *state, int j)
{
    return dot(supervisor_C[j], state, WATCH) + supervisor_d[j];
}

/* A forecast from where the machine is now */
static void begin_window(supervisor_kept *k, int at)
{
    forecast_window *one = &k->window[at];
    int j, w;
    memset(one, 0, sizeof *one);
    memcpy(one->state[0], k->x, sizeof k->x);
    add_product(one->state[0], supervisor_M[0], k->e, WATCH, OUTPUTS);
    memcpy(one->state[1], one->state[0], sizeof k->x);
    memcpy(one->state[1] + WATCH - OUTPUTS, k->slow, sizeof k->slow);
    for (j = 0; j < OUTPUTS; j++) {
        one->began[j] = forecast(one->state[0], j);
        /* a sensor may be far from its forecast: whether it moves is told from its own readings */
        one->first[j] = one->least[j] = one->most[j] = isfinite(k->y[j]) ? k->y[j] : one->began[j];
    }
    for (w = 0; w < WINDOWS; w++)
        memset(k->window[w].cross[at], 0, sizeof one->cross[at]);
}

static void move_state(real *x, const real *on)
{
    real after[WATCH];
    memcpy(after, on, sizeof after);
    add_product(after, supervisor_A[0], x, WATCH, WATCH);
    memcpy(x, after, sizeof after);
}

/* response(t+1) = A response + B by, column by column */
static void move_response(real response[WATCH][INPUTS], const real *by)
{
    real after[WATCH][INPUTS];
    int i, j, l;
    for (i = 0; i < WATCH; i++)
        for (l = 0; l < INPUTS; l++)
            after[i][l] = supervisor_B[i][l] * by[l];
    for (i = 0; i < WATCH; i++)
        for (j = 0; j < WATCH; j++)
            for (l = 0; l < INPUTS && supervisor_A[i][j] != 0; l++)
                after[i][l] += supervisor_A[i][j] * response[j][l];
    memcpy(response, after, sizeof after);
}

/* Observer and windows a sample on, inputs u applied */
static void advance(supervisor_kept *k, const real *u)
{
    real on[WATCH], above[INPUTS], ones[INPUTS];
    int i, w;
    memcpy(on, supervisor_b, sizeof on);
    add_product(on, supervisor_B[0], u, WATCH, INPUTS);
    for (i = 0; i < INPUTS; i++) {
        above[i] = u[i] - supervisor_low[i];
        ones[i] = 1;
    }
    for (w = 0; w < WINDOWS; w++) {
        forecast_window *one = &k->window[w];
        if (one->age < 0)
            continue;
        one->age++;
        move_state(one->state[0], on);
        move_state(one->state[1], on);
        move_response(one->given, above);
        move_response(one->unit, ones);
    }
    move_state(k->x, on);
    add_product(k->x, supervisor_L[0], k->e, WATCH, OUTPUTS);
}

/* The response of output j to input i, of a window's given or unit */
static real response_of(const real *response, int j, int i)
{
    real sum = 0;
    int n;
    for (n = 0; n < WATCH; n++)
        sum += supervisor_C[j][n] * response[n * INPUTS + i];
    return sum;
}

/* Readings that count against every window: what moved, and the sums of the fits */
static void compare(supervisor_kept *k, const real *y, const int *counts)
{
    real signature[WINDOWS][SIGNATURES], missed[WINDOWS];
    int i, j, w, v, f;
    for (w = 0; w < WINDOWS; w++)
        for (j = 0; j < OUTPUTS && k->window[w].age >= 0; j++)
            if (counts[j]) {
                forecast_window *one = &k->window[w];
                real moved = y[j] - one->began[j];
                one->least[j] = fmin(one->least[j], y[j]);
                one->most[j] = fmax(one->most[j], y[j]);
                one->total[0][j] += moved;
                one->total[1][j] += moved * moved;
            }
    for (i = 0; i < PAIRS; i++) {
        int input = supervisor_input_of[i];
        real span = supervisor_high[input] - supervisor_low[input];
        j = supervisor_of_input[i];
        for (w = 0; w < WINDOWS; w++) {
            forecast_window *one = &k->window[w];
            real given = 0, unit = 0;
            missed[w] = 0;
            if (one->age >= 0) {
                given = response_of(one->given[0], j, input);
                unit = response_of(one->unit[0], j, input);
                missed[w] = counts[j] ? y[j] - forecast(one->state[1], j) : 0;
            }
            signature[w][OF_LACKS] = -given;
            signature[w][OF_HEAT] = span * unit;
            one->gives[i] += (span * unit - given) * (span * unit - given);
            signature[w][OF_LATE] = one->before[i] - given;
            signature[w][OF_SHIFTS] = one->age < 0 ? 0 : 1;
            one->before[i] = given;
            one->square[i] += missed[w] * missed[w];
            for (f = 0; f < SIGNATURES; f++)
                one->causes[i][f] += signature[w][f] * signature[w][f];
        }
        for (w = 0; w < WINDOWS; w++)
            for (v = 0; v < WINDOWS; v++)
                for (f = 0; f < SIGNATURES; f++)
                    k->window[w].cross[v][i][f] += missed[w] * signature[v][f];
    }
}

/* How often its noise a reading deviates, with its steps */
static real coarser(const supervisor_kept *k, int j)
{
    return largest(1, steps_of(k, j) / sqrt(REAL(12.0)) / supervisor_noise[j]);
}

/* By how many degC a reading may vary that stands still */
static real same_degC(const supervisor_kept *k, int j)
{
    return largest(SAME_STEPS * steps_of(k, j), SAME_NOISE * supervisor_noise[j]);
}

/* By how many degC a forecast must move, or be missed, before a sensor or heater is judged */
static real threshold(const supervisor_kept *k, int w, int j)
{
    int age = k->window[w].age < 0 ? 0 : k->window[w].age;
    real least = largest(STEPS_STILL * steps_of(k, j), NOISE_STILL * supervisor_noise[j]);
    if (age > WINDOWS * SPACING)
        age = WINDOWS * SPACING;
    return largest(least, NOISE_STILL * supervisor_unsure[age][j] * coarser(k, j));
}

static real doubt_of(const supervisor_kept *k, int w, int j)
{
    real doubt = 0;
    int i;
    for (i = 0; i < INPUTS; i++)
        doubt += DOUBT * fabs(response_of(k->window[w].unit[0], j, i)) * k->stirred[i];
    return doubt;
}

/* Squares that noise and a wandering forecast leave of what a window missed */
static real noise_of(const supervisor_kept *k, int w, int j)
{
    real deviation = 2 * supervisor_noise[j], wander;
    int age = k->window[w].age < 0 ? 0 : k->window[w].age;
    wander = supervisor_wander[age > WINDOWS * SPACING ? WINDOWS * SPACING : age][j];
    return ((age < 1 ? 1 : age) * (deviation * deviation) + wander) * (coarser(k, j) * coarser(k, j));
}

/* By how many degC both forecasts of a window, from the drift as it was and from its mean, are above y, or below
 * it if negative; 0 if y lies between them */
static real both_ahead(const forecast_window *one, int j, real y)
{
    real first = forecast(one->state[0], j) - y, second = forecast(one->state[1], j) - y;
    if (first * second <= 0)
        return 0;
    return fabs(first) < fabs(second) ? first : second;
}

/* Clears sensors that move as forecast; how far each forecast has moved, and from which readings stand away */
static void clear_sensors(supervisor_kept *k, const int *counts, real moves[WINDOWS][OUTPUTS],
                          int still[WINDOWS][OUTPUTS])
{
    int j, w;
    for (w = 0; w < WINDOWS; w++)
        for (j = 0; j < OUTPUTS; j++) {
            forecast_window *one = &k->window[w];
            real least = threshold(k, w, j), move = forecast(one->state[0], j) - one->began[j];
            int large = one->age > 0 && fabs(move) >= least;
            real share = (k->y[j] - one->first[j]) / (large ? move : 1);
            if (large && share >= FOLLOWS_LEAST && share <= FOLLOWS_MOST && k->bad[j] == 0)
                k->cleared[j] = k->now;
            one->away[j] = large ? one->away[j] + 1 : 0;
            moves[w][j] = both_ahead(one, j, one->began[j]);
            move = fabs(moves[w][j]);
            still[w][j] = counts[j]
                          && ((one->away[j] >= STILL_AFTER && move >= largest(least, doubt_of(k, w, j)))
                              /* a healthy sensor repeats itself for long only if its steps are coarser than noise */
                              || (one->age >= FIT_AFTER && k->repeats[j] >= one->age
                                  && steps_of(k, j) <= supervisor_noise[j]
                                  && move >= NOISE_STILL * supervisor_noise[j]));
        }
}

static int unmoved(const supervisor_kept *k, int w, int j)
{
    return k->window[w].most[j] - k->window[w].least[j] <= same_degC(k, j);
}

/* What an explanation leaves of the squares that a window missed, and its amount; no explanation begins before
 * the window does */
static real left_of(const supervisor_kept *k, int w, int v, int i, int f, real *amount)
{
    static const int of[EXPLANATIONS] = {OF_LACKS, OF_LACKS, OF_HEAT, OF_LATE, OF_LACKS, OF_SHIFTS};
    const forecast_window *one = &k->window[w], *other = &k->window[v];
    real cross = one->cross[v][i][of[f]], square = f == GIVES ? other->gives[i] : other->causes[i][of[f]];
    if (f == GIVES)
        cross += one->cross[v][i][OF_HEAT];
    *amount = cut(cross / largest(square, REAL(1e-12)), explanation_least[f], explanation_most[f]);
    if (other->age > one->age || other->age < REPEATED)
        return INFINITY;
    return one->square[i] - 2 * *amount * cross + *amount * *amount * square;
}

static real floor_of(const supervisor_kept *k, int w, int i)
{
    return noise_of(k, w, supervisor_of_input[i]) + MISFIT * MISFIT * k->window[w].square[i] + REAL(1e-12);
}

/* The least that anything that is no fault leaves */
static real honest_of(const supervisor_kept *k, int w, int i)
{
    real amount, at_least = floor_of(k, w, i), best = largest(k->window[w].square[i], at_least);
    int v, f;
    for (v = 0; v < WINDOWS; v++)
        for (f = HEAT; f < EXPLANATIONS; f++)
            best = fmin(best, largest(left_of(k, w, v, i, f, &amount), at_least));
    return best;
}

/* An output stands still, or shows noise alone, while its forecast moves: its sensor, or its heater */
static void say_still(supervisor_kept *k, int j, real moves_degC)
{
    say(k, k->repeats[j] >= STILL_AFTER / 2 ? SENSOR_STILL : SENSOR_DEAF, j, moves_degC);
}

/* Says which sensors stand still, as long as nothing that is no fault explains that as well */
static void judge_sensors(supervisor_kept *k, real moves[WINDOWS][OUTPUTS], int still[WINDOWS][OUTPUTS])
{
    int i, j, w;
    for (j = 0; j < OUTPUTS; j++) {
        int at = -1;
        for (w = 0; w < WINDOWS; w++) {
            const forecast_window *one = &k->window[w];
            real age = one->age < 1 ? 1 : one->age, honest = INFINITY, square = 0, steady, at_least;
            if (!still[w][j] || !unmoved(k, w, j)
                || fabs(moves[w][j]) < SAME_STEPS * (one->most[j] - one->least[j]))
                continue;
            for (i = 0; i < PAIRS; i++)
                if (supervisor_of_input[i] == j) {
                    honest = fmin(honest, honest_of(k, w, i));
                    square = largest(square, one->square[i]);
                }
            steady = one->total[1][j] - one->total[0][j] * one->total[0][j] / age;
            at_least = noise_of(k, w, j) + MISFIT * MISFIT * square + REAL(1e-12);
            /* what moves a heater is a reading that moved: nothing honest keeps one equal meanwhile,
               unless its steps hide what the law makes up for */
            if (((k->repeats[j] >= age && steps_of(k, j) <= supervisor_noise[j])
                 || age * log(honest / largest(steady, at_least)) >= CLEARER)
                && (at < 0 || fabs(moves[w][j]) > fabs(moves[at][j])))
                at = w;
        }
        if (at >= 0)
            say_still(k, j, moves[at][j]);
    }
}

/* Says whose heat is missing for long, as long as its output does not rise */
static void judge_heat(supervisor_kept *k, const real *y, const int *counts)
{
    int i, j, w, oldest = 0;
    for (w = 1; w < WINDOWS; w++)
        if (k->window[w].age > k->window[oldest].age)
            oldest = w;
    for (i = 0; i < INPUTS; i++) {
        real lost = -dot(supervisor_heat[i], k->x + WATCH - OUTPUTS, OUTPUTS), told;
        real least = k->asked[i] >= supervisor_high[i] ? AT_LIMIT : MISSING;
        j = supervisor_of_input[i];
        if (counts[j] && k->window[oldest].age >= (WINDOWS - 1) * SPACING
            && y[j] - k->window[oldest].first[j] <= same_degC(k, j) && lost >= least)
            k->missing[i]++;
        else
            k->missing[i] = 0;
        told = (k->usual[i] - supervisor_low[i]) / (supervisor_high[i] - supervisor_low[i]);
        if (k->missing[i] >= MISSING_FOR)
            say(k, HEATER_WEAK, i, lost / largest(told, lost));
    }
}

/* Says which heater heats otherwise than it was told: the one that explains most */
static void judge_heaters(supervisor_kept *k, const real *y, const int *counts,
                          real moves[WINDOWS][OUTPUTS])
{
    real share[WINDOWS][INPUTS];
    int clear[WINDOWS][INPUTS], gives[WINDOWS][INPUTS], shows[2][INPUTS] = {{0}};
    int i, w, v, f, at = -1, of = 0;
    for (i = 0; i < INPUTS; i++)
        for (w = 0; w < WINDOWS; w++) {
            const forecast_window *one = &k->window[w];
            int j = supervisor_of_input[i];
            real at_least = floor_of(k, w, i), best = INFINITY, amount;
            real needed = largest(threshold(k, w, j), doubt_of(k, w, j));
            clear[w][i] = gives[w][i] = 0;
            share[w][i] = 0;
            if (one->age < FIT_AFTER || !counts[j]
                || fabs(y[j] - forecast(one->state[1], j)) < needed)
                continue;
            for (f = LACKS; f <= GIVES; f++)
                for (v = 0; v < WINDOWS; v++) {
                    real left = largest(left_of(k, w, v, i, f, &amount), at_least);
                    if (left < best) {
                        best = left;
                        share[w][i] = amount;
                        gives[w][i] = f == GIVES;
                    }
                }
            /* a heater that is stuck on heats, and by more than the drift of either forecast */
            if (gives[w][i] && (y[j] - one->least[j] <= same_degC(k, j) || -both_ahead(one, j, y[j]) < needed))
                continue;
            clear[w][i] = best < INFINITY && best <= 2 * at_least && one->age * log(honest_of(k, w, i) / best) >= CLEARER;
            if (clear[w][i])
                shows[!gives[w][i]][i] = 1;
        }
    for (i = 0; i < INPUTS; i++)
        for (f = 0; f < 2; f++)
            k->shown[f][i] = shows[f][i] ? k->shown[f][i] + 1 : 0;
    for (w = 0; w < WINDOWS; w++)
        for (i = 0; i < INPUTS; i++)
            if (clear[w][i] && (k->shown[0][i] >= SHOWN || k->shown[1][i] >= SHOWN)
                && (at < 0 || k->window[w].square[i] > k->window[at].square[of])) {
                at = w;
                of = i;
            }
    if (at >= 0 && unmoved(k, at, supervisor_of_input[of]))
        say_still(k, supervisor_of_input[of], moves[at][supervisor_of_input[of]]);
    else if (at >= 0 && gives[at][of])
        say(k, HEATER_STUCK_ON, of, share[at][of]);
    else if (at >= 0)
        say(k, HEATER_WEAK, of, share[at][of]);
}

/* Whether a heater is tried again: the heaters are off for this cause and its output moves as forecast, or
 * the machine's own control heats and the cause is gone. RETURNS times an hour, then a person is waited for. */
static int tried_again(supervisor_kept *k, int kind, int signal, int gone)
{
    int j = kind == HEATER_STUCK_ON || kind == HEATER_WEAK ? supervisor_of_input[signal] : signal;
    int rested = k->now - k->returned[j] > SECONDS(REAL(3600.0));
    int heated = kind == HEATER_WEAK && k->amount[kind][signal] >= 0;
    int over = heated ? gone : k->cleared[j] > k->last[kind][signal];
    if (!over || (!rested && k->returns[j] >= RETURNS))
        return 0;
    k->returns[j] = rested ? 1 : k->returns[j] + 1;
    k->returned[j] = k->now;
    k->cleared[j] = NEVER; /* what cooled as forecast may yet be out of place */
    return 1;
}

/* Causes that are gone */
static void forget(supervisor_kept *k)
{
    int kind, signal, any = 0;
    for (kind = 0; kind < KINDS && k->active; kind++)
        for (signal = 0; signal < SIGNALS; signal++) {
            int counted = kind == SENSOR_STILL || kind == SENSOR_DEAF || kind == HEATER_STUCK_ON
                          || kind == HEATER_WEAK;
            int gone = k->now - k->last[kind][signal] > SECONDS(BACK_S);
            if (k->since[kind][signal] < 0 || !(counted ? tried_again(k, kind, signal, gone) : gone))
                continue;
            k->since[kind][signal] = k->last[kind][signal] = -1;
            k->active--;
            any = 1;
        }
    if (any)
        end_windows(k);
}

static void follow_law(supervisor_kept *k, const real *y, const int *counts)
{
    real moves[WINDOWS][OUTPUTS];
    int still[WINDOWS][OUTPUTS], j;
    for (j = 0; j < OUTPUTS; j++)
        k->slow[j] += SLOWLY * (k->x[WATCH - OUTPUTS + j] - k->slow[j]);
    compare(k, y, counts);
    judge_heat(k, y, counts);
    clear_sensors(k, counts, moves, still);
    judge_sensors(k, moves, still);
    judge_heaters(k, y, counts, moves);
}

/* The observer at the last readings, as if inputs had reached them */
static void begin_anew(supervisor_kept *k)
{
    real from[OUTPUTS];
    int j;
    for (j = 0; j < OUTPUTS; j++) {
        from[j] = isfinite(k->y[j]) ? k->y[j] : supervisor_d[j];
        k->slow[j] = 0;
    }
    memcpy(k->x, supervisor_start_0, sizeof k->x);
    add_product(k->x, supervisor_start[0], from, WATCH, OUTPUTS);
    end_windows(k);
}

/* One sample of outputs y, inputs `applied` since the one before, none of `samples` in manual; `filled` is y
 * with what does not count as forecast */
static void follow(supervisor_kept *k, const real *y, const real *applied, int samples, real *filled)
{
    real u[INPUTS];
    int counts[OUTPUTS], begins = !k->samples, settles = !samples || k->samples < SETTLES, i, j, step;
    for (j = 0; j < OUTPUTS; j++)
        begins |= isnan(k->y[j]) && isfinite(y[j]) && y[j] >= supervisor_coldest[j] && y[j] <= supervisor_hottest[j];
    for (i = 0; i < INPUTS; i++)
        u[i] = cut(applied && isfinite(applied[i]) ? applied[i] : k->asked[i], supervisor_low[i],
                   supervisor_high[i])
               - k->forward[i];
    read_sensors(k, y, counts);
    for (step = 0; k->samples && step < (samples > 1 ? samples : 1); step++) {
        advance(k, u);
        if (settles && !step)
            add_product(k->x, supervisor_hurried[0], k->e, WATCH, OUTPUTS);
        else if (step)
            memset(k->e, 0, sizeof k->e);
    }
    for (j = 0; j < OUTPUTS; j++)
        begins |= fabs(forecast(k->x, j)) > FAR_DEGC;
    if (begins)
        begin_anew(k);
    for (j = 0; j < OUTPUTS; j++) {
        k->expected[j] = forecast(k->x, j);
        filled[j] = counts[j] ? y[j] : k->expected[j];
    }
    for (i = 0; i < INPUTS; i++) {
        k->usual[i] = !samples && k->samples < 2 ? u[i] : k->usual[i] + SLOWLY * (u[i] - k->usual[i]);
        k->stirred[i] = samples ? largest(fabs(u[i] - k->usual[i]), (1 - RESTS) * k->stirred[i]) : 0;
    }
    if (settles) {
        end_windows(k);
        memcpy(k->slow, k->x + WATCH - OUTPUTS, sizeof k->slow);
    } else
        follow_law(k, filled, counts);
    for (j = 0; j < OUTPUTS; j++)
        k->e[j] = counts[j] ? filled[j] - k->expected[j] : 0;
    forget(k);
    if (!settles && k->samples % SPACING == 0)
        begin_window(k, k->samples / SPACING % WINDOWS);
    k->samples++;
}

/* The safe mode of the causes that are there */
static int find_mode(supervisor_kept *k)
{
    int kind, signal, mode = k->active ? MODE_OWN : MODE_LAW;
    for (kind = 0; kind < KINDS; kind++)
        for (signal = 0; signal < SIGNALS; signal++) {
            if (k->since[kind][signal] < 0)
                continue;
            if (kind == HEATER_WEAK && k->amount[kind][signal] >= 0
                && k->last[kind][signal] - k->cleared[supervisor_of_input[signal]] > SECONDS(CLEARED_S))
                k->amount[kind][signal] = -k->amount[kind][signal];
            if (kind < HEATER_WEAK || (kind == HEATER_WEAK && k->amount[kind][signal] < 0))
                mode = MODE_OFF;
        }
    return mode;
}
