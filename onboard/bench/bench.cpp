// bench WEIGHTS K CALLS PAUSE_US: time of scoring K candidates, one line for each call.
//
// A line is the wall time and the processor time of a call, in ns. The thread sleeps
// PAUSE_US between calls, as a planner does between cycles; inputs change with the call.
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <random>
#include <vector>

#include "rcirl/reward.hpp"

namespace {

long long nanoseconds(clockid_t clock) {
  timespec now;
  clock_gettime(clock, &now);
  return 1000000000LL * now.tv_sec + now.tv_nsec;
}

}  // namespace

int main(int count, char** arguments) {
  rcirl::Reward reward;
  const rcirl::Status status =
      count == 5 ? rcirl::load(arguments[1], &reward)
                 : rcirl::Status("bench: arguments: expected WEIGHTS K CALLS PAUSE_US");
  if (!status.ok()) {
    std::fprintf(stderr, "%s\n", status.message().c_str());
    return 2;
  }
  constexpr int kSets = 8, kWarmUp = 50;
  const std::size_t candidates = std::strtoul(arguments[2], nullptr, 10);
  const int calls = std::atoi(arguments[3]);
  const timespec pause = {0, 1000 * std::atol(arguments[4])};
  const std::size_t size = candidates * reward.times().size() * reward.features().size();
  std::mt19937 random(0);
  std::normal_distribution<float> draw(0.0f, 2.0f);
  std::vector<float> features(kSets * size), values(candidates);
  for (float& value : features) value = draw(random);
  rcirl::Workspace workspace = reward.workspace();
  std::size_t refused = 0;
  for (int call = -kWarmUp; call < calls; ++call) {
    if (pause.tv_nsec > 0) nanosleep(&pause, nullptr);
    const float* set = &features[size * static_cast<std::size_t>((call + kWarmUp) % kSets)];
    const long long wall = nanoseconds(CLOCK_MONOTONIC);
    const long long used = nanoseconds(CLOCK_THREAD_CPUTIME_ID);
    refused += reward.score(set, candidates, {}, &workspace, values.data());
    const long long used_after = nanoseconds(CLOCK_THREAD_CPUTIME_ID);
    const long long wall_after = nanoseconds(CLOCK_MONOTONIC);
    if (call >= 0) std::printf("%lld %lld\n", wall_after - wall, used_after - used);
  }
  return refused == 0 ? 0 : 1;
}
