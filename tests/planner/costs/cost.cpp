// The cost of costs.py as a C library.
#include <algorithm>
#include <cmath>

#include "rcirl/cost_abi.h"

extern "C" int32_t rcirl_cost_abi() { return RCIRL_COST_ABI; }

extern "C" int32_t rcirl_cost(const rcirl_scene *scene, const rcirl_candidates *x,
                              double *cost) {
  const int times = x->num_times;
  for (int k = 0; k < x->count; ++k) {
    double sum = 0.0;
    for (int t = 0; t < times; ++t) {
      const int at = k * times + t;
      const int station = std::clamp(static_cast<int>(x->s[at] / scene->station_step), 0,
                                     scene->num_stations - 1);
      double gap = 1e3;
      for (int n = 0; n < scene->num_obstacles; ++n) {
        const int slot = n * times + t;
        const double ahead = scene->s_lower[slot] - x->s[at] - 0.5 * scene->ego_length;
        if (scene->valid[slot] && ahead > 0.0 && scene->l_lower[slot] < x->l[at] + 1.0 &&
            scene->l_upper[slot] > x->l[at] - 1.0) {
          gap = std::min(gap, ahead);
        }
      }
      const double headway = std::max(2.0 - gap / std::max(x->v[at], 1.0f), 0.0);
      const double offset = x->l[at] - scene->path_l[station];
      const double slower = std::abs(scene->path_speed_limit[station] - x->v[at]);
      sum += 4.0 * headway * headway + 0.5 * offset * offset +
             0.02 * x->j[at] * x->j[at] + 0.3 * slower;
    }
    cost[k] = sum / times;
  }
  return 0;
}
