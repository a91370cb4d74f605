// A learned reward in Apollo's lattice planner: the pairs of its TrajectoryEvaluator, ranked
// by their cost and the learned value.
//
//   cost = Apollo's cost - gain V      weights with a prior cost on "hand-set", which is
//                                      Apollo's lattice cost: the gain is in its units
//   cost = -V                          weights that drive alone; Apollo's cost among equals
//
// `RewardEvaluator` has the members of the evaluator that the planner uses, so that the loop
// behind it, with Apollo's constraint and collision checks, stays as it is: a value says
// nothing of safety. docs/own_planner.md has the lines to change. Templates on Apollo's
// types, which move between its versions: include it behind Apollo's headers. Tested against
// a stand-in of them (tests/apollo), not in Apollo.
#ifndef RCIRL_ADAPTERS_APOLLO_REWARD_EVALUATOR_HPP_
#define RCIRL_ADAPTERS_APOLLO_REWARD_EVALUATOR_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <map>
#include <set>
#include <type_traits>
#include <utility>
#include <vector>

#include "rcirl/features.hpp"
#include "rcirl/scene_builder.hpp"

namespace rcirl_apollo {

// m from Apollo's place of the car, its rear axle, ahead to the middle of its box.
template <typename VehicleParam>
double to_centre(const VehicleParam& car) {
  return 0.5 * (car.front_edge_to_center() - car.back_edge_to_center());
}

// What the lattice planner knows of a moment on one reference line.
//
//   start    the planning_init_point
//   points   the reference line as PathPoints
//   line     the ReferenceLine, for its limits and its width
//   others   frame->obstacles(), pointers; those of one perceived object count once
//   car      the vehicle_param
//   target   the PlanningTarget, whose stop point is a line that demands a stop
template <typename TrajectoryPoint, typename PathPoints, typename ReferenceLine,
          typename Obstacles, typename VehicleParam, typename PlanningTarget>
rcirl::Surroundings surroundings(const TrajectoryPoint& start, const PathPoints& points,
                                 const ReferenceLine& line, const Obstacles& others,
                                 const VehicleParam& car, const PlanningTarget& target) {
  rcirl::Surroundings now;
  const auto& at = start.path_point();
  const double ahead = to_centre(car);
  now.ego = {at.x() + ahead * std::cos(at.theta()),
             at.y() + ahead * std::sin(at.theta()),
             at.theta(),
             std::max(0.0, start.v()),
             start.a(),
             at.kappa(),
             car.length(),
             car.width()};
  double nearest = -1.0, here = 0.0;
  for (const auto& point : points) {
    now.line.points.push_back({point.x(), point.y()});
    now.line.speed_limit.push_back(line.GetSpeedLimitFromS(point.s()));
    const double apart = std::hypot(point.x() - at.x(), point.y() - at.y());
    if (nearest < 0.0 || apart < nearest) nearest = apart, here = point.s();
  }
  double left = 0.0, right = 0.0;
  if (line.GetLaneWidth(here, &left, &right)) now.line.lane_width = left + right;
  // the place at the stop point is the rear axle's; the line is before the front bumper
  const double stop = target.stop_point().s() + car.front_edge_to_center();
  for (std::size_t i = 1; target.has_stop_point() && i < points.size(); ++i) {
    const auto &from = points[i - 1], &to = points[i];
    if (to.s() < stop && i + 1 < points.size()) continue;
    const double share = (stop - from.s()) / (to.s() - from.s());
    now.signals.push_back({from.x() + share * (to.x() - from.x()),
                           from.y() + share * (to.y() - from.y()), rcirl::SignalState::kRed});
    break;
  }
  std::set<int> seen;
  for (const auto* obstacle : others) {
    using Perceived = std::decay_t<decltype(obstacle->Perception())>;
    if (obstacle->IsVirtual() || !seen.insert(obstacle->Perception().id()).second) continue;
    const auto& box = obstacle->PerceptionBoundingBox();
    const auto type = obstacle->Perception().type();
    rcirl::Other other;
    other.kind = type == Perceived::PEDESTRIAN          ? rcirl::ObstacleKind::kPedestrian
                 : type == Perceived::BICYCLE           ? rcirl::ObstacleKind::kCyclist
                 : type == Perceived::UNKNOWN_UNMOVABLE ? rcirl::ObstacleKind::kStatic
                                                        : rcirl::ObstacleKind::kVehicle;
    other.x = box.center_x(), other.y = box.center_y(), other.heading = box.heading();
    other.speed = obstacle->speed();
    other.length = box.length(), other.width = box.width();
    now.others.push_back(other);
  }
  return now;
}

// A weights file as the planner holds it: read once.
class LearnedCost {
 public:
  explicit LearnedCost(const char* weights) {
    status_ = rcirl::load(weights == nullptr ? "no file" : weights, &reward_);
    if (status_.ok()) status_ = rcirl::feature_map(reward_, &columns_);
  }
  explicit LearnedCost(const rcirl::Reward& reward)
      : reward_(reward), status_(rcirl::feature_map(reward_, &columns_)) {}

  // Why it says nothing; ok where it does.
  const rcirl::Status& status() const { return status_; }
  const rcirl::Reward& reward() const { return reward_; }

  // Costs [K] of candidates in a moment: -gain V, or -V without a prior cost; or why there
  // are none. Those without a value cost infinitely much.
  rcirl::Status costs(const rcirl::Surroundings& now, const rcirl::Candidates& candidates,
                      std::vector<double>* made) const {
    if (!status_.ok()) return status_;
    rcirl::Scene scene;
    const rcirl::Status known = rcirl::scene_from(now, &scene);
    if (!known.ok()) return known;
    const std::size_t count = candidates.count;
    std::vector<float> features(count * rcirl::kTimes * columns_.size()), values(count);
    rcirl::Workspace workspace = reward_.workspace();
    columns_.compute(scene, candidates, features.data());
    const rcirl::Mask mask = columns_.mask(scene);
    if (reward_.has_prior_cost()) {
      const std::vector<float> nothing(count, 0.0f);  // Apollo's cost is added in double
      reward_.total(features.data(), count, mask, nothing.data(), &workspace, values.data());
    } else {
      reward_.score(features.data(), count, mask, &workspace, values.data());
    }
    made->clear();
    for (const float value : values) made->push_back(-static_cast<double>(value));
    return rcirl::Status();
  }

 private:
  rcirl::Reward reward_;
  rcirl::FeatureMap columns_;
  rcirl::Status status_;
};

// The pairs of an evaluator of Apollo's, the cheapest first, as the planner asks for them.
template <typename TrajectoryEvaluator>
class RewardEvaluator {
 public:
  using Pair = decltype(std::declval<TrajectoryEvaluator&>().next_top_trajectory_pair());

  // Takes all pairs of `apollo`. Without a value, its order and costs stay.
  //
  //   now     of `surroundings`
  //   init_s  [0] m, the car's station on the reference line
  //   ahead   `to_centre`
  template <typename InitS>
  RewardEvaluator(TrajectoryEvaluator* apollo, const LearnedCost& learned,
                  const rcirl::Surroundings& now, const InitS& init_s, double ahead) {
    while (apollo->has_more_trajectory_pairs()) {
      const double cost = apollo->top_trajectory_pair_cost();
      pairs_.push_back({apollo->next_top_trajectory_pair(), cost});
    }
    const bool aside = learned.status().ok() && learned.reward().mode() == "path_speed";
    // one candidate for each longitudinal curve, or for each pair where l was trained
    using Key = std::pair<const void*, const void*>;
    std::map<Key, std::size_t> places;
    std::vector<std::size_t> place;
    std::vector<float> s, l;
    for (const Ranked& one : pairs_) {
      const auto &lon = *one.pair.first, &lat = *one.pair.second;
      const Key key{&lon, aside ? static_cast<const void*>(&lat) : nullptr};
      const auto found = places.insert({key, places.size()});
      place.push_back(found.first->second);
      if (!found.second) continue;
      double way = 0.0;
      for (std::size_t t = 0; t < rcirl::kTimes; ++t) {
        const double time = 8.0 * static_cast<double>(t) / 17.0;
        way = std::max(way, lon.Evaluate(0, time) - init_s[0]);  // none drives backward
        s.push_back(static_cast<float>(way));
        const double beside = lat.Evaluate(0, way) + ahead * lat.Evaluate(1, way);
        if (aside) l.push_back(static_cast<float>(beside));
      }
    }
    std::vector<double> costs;
    status_ = learned.costs(now, {s.data(), aside ? l.data() : nullptr, places.size()}, &costs);
    if (!status_.ok()) return;
    const bool on_top = learned.reward().has_prior_cost();
    for (std::size_t i = 0; i < pairs_.size(); ++i) {
      pairs_[i].cost = costs[place[i]] + (on_top ? pairs_[i].cost : 0.0);
    }
    std::stable_sort(pairs_.begin(), pairs_.end(),
                     [](const Ranked& a, const Ranked& b) { return a.cost < b.cost; });
  }

  // Why the learned value says nothing here, one line; ok where it does.
  const rcirl::Status& status() const { return status_; }

  bool has_more_trajectory_pairs() const { return next_ < pairs_.size(); }
  std::size_t num_of_trajectory_pairs() const { return pairs_.size() - next_; }
  Pair next_top_trajectory_pair() { return pairs_[next_++].pair; }
  double top_trajectory_pair_cost() const { return pairs_[next_].cost; }

 private:
  struct Ranked {
    Pair pair;
    double cost;
  };

  std::vector<Ranked> pairs_;
  std::size_t next_ = 0;
  rcirl::Status status_;
};

}  // namespace rcirl_apollo

#endif  // RCIRL_ADAPTERS_APOLLO_REWARD_EVALUATOR_HPP_
