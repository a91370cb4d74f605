/* A planner's own cost as a C library, for `rcirl ... --incumbent=libcost.so`.
 *
 * A library exports the two functions at the end. It is asked for the costs of all
 * candidates of one scene at a time, in a process of its own; it keeps nothing between
 * two calls. Numbers are SI units and radians, in the scene's Frenet frame: station s
 * along the reference line, 0 at the ego's centre at t = 0; l to its left.
 *
 *     c++ -O2 -shared -fPIC -I onboard/include -o libcost.so my_cost.cpp
 */
#ifndef RCIRL_COST_ABI_H
#define RCIRL_COST_ABI_H

#include <stdint.h>

#define RCIRL_COST_ABI 1

#ifdef __cplusplus
extern "C" {
#endif

/* One scene. Tables of obstacles are [num_obstacles * num_times], row by row. */
typedef struct rcirl_scene {
  float ego_s, ego_l, ego_dl, ego_ddl; /* m, m, 1, 1/m: dl/ds and d2l/ds2 */
  float ego_v, ego_a;                  /* m/s, m/s2, along the reference line */
  float ego_length, ego_width;         /* m */
  int32_t num_stations;                /* points of the path's tables */
  float station_step;                  /* m between them, the first at s = 0 */
  const float *path_kappa;             /* 1/m, of the reference line */
  const float *path_l;                 /* m, the given path */
  const float *path_speed_limit;       /* m/s, what the planner may drive */
  const float *path_lane_left, *path_lane_right; /* m, l of the ego lane's bounds */
  const float *path_road_left, *path_road_right; /* m, l of the road's edges */
  int32_t num_times;                   /* 18 times from 0 to 8 s */
  const float *times;                  /* s */
  const uint8_t *time_valid;           /* 1: the scene is known at that time */
  int32_t num_obstacles;               /* slots; one without any valid time is empty */
  const int32_t *kind;                 /* 1 vehicle, 2 cyclist, 3 pedestrian, 4 static,
                                          5 stop line, 6 destination, 0 none */
  const float *obstacle_a, *obstacle_l_dot; /* m/s2, m/s at t = 0 */
  const float *s_lower, *s_upper;      /* m, rear and front end */
  const float *l_lower, *l_upper;      /* m, right and left side */
  const float *speed;                  /* m/s along the reference line, signed */
  const uint8_t *valid;                /* 1: is there at that time */
} rcirl_scene;

/* Candidates of the scene; tables are [count * num_times], row by row. */
typedef struct rcirl_candidates {
  int32_t count, num_times;
  const float *s, *v, *a, *j;          /* m, m/s, m/s2, m/s3 */
  const float *l, *dl, *ddl;           /* m, 1, 1/m */
  const uint8_t *feasible;             /* [count] 1: inside the vehicle's limits */
} rcirl_candidates;

/* RCIRL_COST_ABI, as the library was compiled. */
int32_t rcirl_cost_abi(void);

/* Writes the cost of every candidate, lower is better; finite for feasible ones.
 * Returns 0, or a number of its own if it cannot. */
int32_t rcirl_cost(const rcirl_scene *scene, const rcirl_candidates *candidates,
                   double *cost);

#ifdef __cplusplus
}
#endif

#endif /* RCIRL_COST_ABI_H */
