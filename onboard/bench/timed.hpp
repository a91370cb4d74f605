// Wall time and processor time of a call.
#ifndef RCIRL_BENCH_TIMED_HPP_
#define RCIRL_BENCH_TIMED_HPP_

#include <cstdio>
#include <ctime>

inline long long nanoseconds(clockid_t clock) {
  timespec now;
  clock_gettime(clock, &now);
  return 1000000000LL * now.tv_sec + now.tv_nsec;
}

// Calls after a pause, as a planner does between cycles; prints both times in ns unless it
// is to warm up.
template <typename Call>
void timed(bool counts, long pause_us, const Call& call) {
  const timespec pause = {0, 1000 * pause_us};
  if (pause.tv_nsec > 0) nanosleep(&pause, nullptr);
  const long long wall = nanoseconds(CLOCK_MONOTONIC);
  const long long used = nanoseconds(CLOCK_THREAD_CPUTIME_ID);
  call();
  const long long used_after = nanoseconds(CLOCK_THREAD_CPUTIME_ID);
  const long long wall_after = nanoseconds(CLOCK_MONOTONIC);
  if (counts) std::printf("%lld %lld\n", wall_after - wall, used_after - used);
}

#endif  // RCIRL_BENCH_TIMED_HPP_
