/* ---- the law */

/* One plant of the governor's family: its state with the inputs at their strongest, by how much less at their
 * weakest, and four sums of what its innovations told */
typedef struct {
    real strongest[WATCHED], lacks[WATCHED], sums[4][OUTPUTS];
} member_state;

/* All that a law remembers */
typedef struct {
    real z[MEMORY], xi[OUTPUTS], u[INPUTS];
    real r[OUTPUTS], feed[INPUTS], y_star[OUTPUTS];
    real forward[INPUTS]; /* what makes up for the disturbances */
    real told[DISTURBANCES + 1], before[DISTURBANCES + 1], kick[DISTURBANCES + 1];
    member_state x[MEMBERS];
    int seen, aimed;
} law_state;
