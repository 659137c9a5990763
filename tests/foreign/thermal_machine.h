/* A heated machine as a network of masses; see thermal_machine.c. Beadline's own code has no part in it. */
#ifndef THERMAL_MACHINE_H
#define THERMAL_MACHINE_H

#include <stdint.h>

enum { NODES = 16, EDGES = 24, HEATERS = 5, SENSORS = 5, LINES = 4, CELLS = 24 };
enum { ROOM, FAN, FLOW, DOOR, OUTSIDE }; /* what acts from outside, a column each */

/* The constants of a machine, all doubles so that a table of them is the machine. The first `nodes`, ... of each
 * array count. `flow` is the feed in mm/s or the screw's speed in rpm. */
typedef struct {
    double sample_s, substeps, nodes, edges, heaters, sensors, lines;
    /* by node: heat capacity J/K; losses to the room W/K, W/K^(5/4), W/K^4; share by which the full fan raises
     * the convection; W/K through an open door; J/K of cold material by unit of flow; W by flow^1.4 of shear */
    double capacity[NODES], linear[NODES], convection[NODES], radiation[NODES], fan[NODES], door[NODES];
    double feed[NODES], shear[NODES];
    /* by edge between two nodes: W/K, W/K^(5/4), and the share by which the full fan raises the latter */
    double from[EDGES], to[EDGES], conduction[EDGES], natural[EDGES], blown[EDGES];
    /* by heater: W at full duty, node, period of the pulse width modulation in s, shortest pulse and pause in s,
     * levels of the duty */
    double power[HEATERS], heats[HEATERS], period_s[HEATERS], shortest_s[HEATERS], levels[HEATERS];
    /* by sensor: node, lag in s, step of the converter in degC, noise before the step in degC */
    double senses[SENSORS], lag_s[SENSORS], step[SENSORS], noise[SENSORS];
    /* by transport line: nodes at its ends, J/K by unit of flow and second, cells, flow x s by cell */
    double upstream[LINES], downstream[LINES], carried[LINES], cells[LINES], by_cell[LINES];
} thermal_parts;

typedef struct {
    double degC[NODES], sensor[SENSORS], line[LINES][CELLS], moved[LINES];
    double on_s[HEATERS], pulse[HEATERS]; /* length of this pulse, and time since it began, in s */
    uint64_t random;
} thermal_state;

/* A person's PID for each heater and the sensor of the same number: percent/degC, percent/(degC s),
 * percent s/degC; what it remembers */
typedef struct {
    double proportional[HEATERS], integral[HEATERS], derivative[HEATERS];
    double sum[HEATERS], last[HEATERS], slope[HEATERS], begun;
} thermal_pid;

void thermal_start(thermal_state *s, const thermal_parts *p, double degC, uint64_t seed);
void thermal_read(thermal_state *s, const thermal_parts *p, double *y);
void thermal_advance(thermal_state *s, const thermal_parts *p, const double *u, const double *outside);
void thermal_balance(const thermal_parts *p, const double *degC, const double *watt, const double *outside,
                     double *heat);
void thermal_control(thermal_pid *c, const thermal_parts *p, const double *r, const double *y, double *u);

#endif
