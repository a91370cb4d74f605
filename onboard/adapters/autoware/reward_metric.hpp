// A learned reward as a metric of Autoware's trajectory ranker (autoware_trajectory_ranker), in
// the versions whose metrics are given the objects: those in which the ranker is a node.
//
// Export it in a package of your own (docs/own_planner.md). The environment variable RCIRL_WEIGHTS names the weights file. With V0 the value of
// keeping speed and offset, the metric of a candidate is, at all of its points,
//
//   1 / (1 + exp((V0 - V) / maximum))      between 0 and 1, higher is better
//
// where `maximum` is the ranker's parameter of that name for this metric. A reward with an
// prior cost adds its gained V to the ranker's other metrics. Traffic lights are not among
// what a metric of the ranker is given. Tested against a stand-in of the ranker's
// interface (tests/autoware), not in Autoware.
#ifndef RCIRL_ADAPTERS_AUTOWARE_REWARD_METRIC_HPP_
#define RCIRL_ADAPTERS_AUTOWARE_REWARD_METRIC_HPP_

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdlib>
#include <memory>
#include <string>
#include <type_traits>
#include <vector>

#include <autoware/trajectory_ranker/interface/metrics_interface.hpp>

#include "rcirl/features.hpp"
#include "rcirl/scene_builder.hpp"

namespace rcirl_autoware {

namespace ranker = ::autoware::trajectory_ranker;
using rcirl::detail::XY;

constexpr double kAroundM = 300.0;  // m from the ego that lanes are looked at
constexpr double kLeastM = 0.3;     // m, least length and width of an object
constexpr std::size_t kWeighted = 6;  // metrics with a time_decay_weight, s0 to s5

template <typename Pose>
double yaw(const Pose& pose) {
  const auto& q = pose.orientation;
  return std::atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z));
}

// The value at t of numbers at rising times, cubic: positions are differentiated later.
inline double at_time(const std::vector<double>& time, const std::vector<double>& x, double t) {
  const std::size_t last = time.size() - 1;
  const auto next = std::upper_bound(time.begin() + 1, time.end() - 1, t);
  const auto i = static_cast<std::size_t>(next - time.begin()) - 1;
  const auto slope = [&](std::size_t k) {
    const std::size_t low = k == 0 ? 0 : k - 1, high = std::min(k + 1, last);
    return (x[high] - x[low]) / (time[high] - time[low]);
  };
  const double h = time[i + 1] - time[i], u = (t - time[i]) / h, r = 1.0 - u;
  return r * r * (1.0 + 2.0 * u) * x[i] + u * u * (3.0 - 2.0 * u) * x[i + 1] +
         h * u * r * (r * slope(i) - u * slope(i + 1));
}

class RewardMetric : public ranker::metrics::MetricInterface {
 public:
  explicit RewardMetric(const char* weights = std::getenv("RCIRL_WEIGHTS"))
      : MetricInterface("RcirlReward") {
    status_ = rcirl::load(weights == nullptr ? "RCIRL_WEIGHTS" : weights, &reward_);
    if (status_.ok()) status_ = rcirl::feature_map(reward_, &columns_);
    if (!status_.ok()) RCLCPP_ERROR_STREAM(rclcpp::get_logger("rcirl"), status_.message());
  }

  void evaluate(const std::shared_ptr<ranker::DataInterface>& result,
                const float max_value) const override {
    if (index() >= kWeighted && !told_) {
      told_ = true;
      RCLCPP_ERROR_STREAM(rclcpp::get_logger("rcirl"),
                          "metrics.name: " + name() + " at place " + std::to_string(index() + 1) +
                              ": expected one of the first " + std::to_string(kWeighted) +
                              "; the ranker gives no weight to a later one");
    }
    const std::size_t size = result->points()->size();
    const float metric = status_.ok() && size > 1 ? preference(*result, max_value) : 0.0f;
    result->set_metric(index(), std::vector<float>(size, metric));
  }

  bool is_deviation() const override { return false; }

 private:
  // The middle of the box, where the ranker has the rear axle's.
  template <typename Pose>
  XY centre(const Pose& pose) const {
    const auto& car = *vehicle_info();
    const double ahead = 0.5 * (car.max_longitudinal_offset_m + car.min_longitudinal_offset_m);
    return {pose.position.x + ahead * std::cos(yaw(pose)),
            pose.position.y + ahead * std::sin(yaw(pose))};
  }

  // What `metric` is for a candidate; 0 where it has no value.
  float preference(const ranker::DataInterface& given, float scale) const {
    const rcirl::Surroundings now = surroundings(given);
    rcirl::Scene scene;
    const rcirl::Status made = rcirl::scene_from(now, &scene);
    if (!made.ok()) {
      RCLCPP_ERROR_STREAM(rclcpp::get_logger("rcirl"), made.message());
      return 0.0f;
    }
    std::vector<float> s(2 * rcirl::kTimes), l(2 * rcirl::kTimes, scene.ego.l);
    scene.num_valid = candidate(given, now, s.data(), l.data());
    for (std::size_t t = 0; t < rcirl::kTimes; ++t) {
      s[rcirl::kTimes + t] = scene.ego.v * rcirl::kHorizonS * static_cast<float>(t) / 17.0f;
    }
    std::vector<float> features(2 * rcirl::kTimes * columns_.size());
    float values[2] = {0.0f, 0.0f};
    rcirl::Workspace workspace = reward_.workspace();
    columns_.compute(scene, {s.data(), l.data(), 2}, features.data());
    const rcirl::Mask mask = columns_.mask(scene);
    const bool refused =
        reward_.has_prior_cost() ? reward_.total(features.data(), 2, mask, values, &workspace, values)
                           : reward_.score(features.data(), 2, mask, &workspace, values);
    return refused ? 0.0f : 1.0f / (1.0f + std::exp((values[1] - values[0]) / scale));
  }

  // Stations and offsets [T] of the candidate; returns how many of its times are known.
  std::size_t candidate(const ranker::DataInterface& given, const rcirl::Surroundings& now,
                        float* s, float* l) const {
    std::vector<XY> points = now.line.points;
    for (XY& point : points) point = {point[0] - now.ego.x, point[1] - now.ego.y};
    const rcirl::detail::Line line(points);
    std::vector<double> time, along, aside;
    for (const auto& point : *given.points()) {
      const double t = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec;
      if (!time.empty() && t <= time.back()) break;  // the ranker repeats the last point
      const XY middle = centre(point.pose);
      const XY at = line.project({middle[0] - now.ego.x, middle[1] - now.ego.y});
      time.push_back(t);
      along.push_back(at[0]);
      aside.push_back(at[1]);
    }
    std::size_t known = 0;
    for (std::size_t i = 0; i < rcirl::kTimes; ++i) {
      const double t = time.front() + 8.0 * static_cast<double>(i) / 17.0;
      const bool there = time.size() > 1 && t <= time.back() + 1e-6;
      s[i] = static_cast<float>((there ? at_time(time, along, t) : along.back()) - along.front());
      l[i] = static_cast<float>(there ? at_time(time, aside, t) : aside.back());
      known += there;
    }
    return std::max(known, std::size_t{1});
  }

  rcirl::Surroundings surroundings(const ranker::DataInterface& given) const {
    const auto& first = given.points()->front();
    const auto& car = *vehicle_info();
    rcirl::Surroundings now;
    const XY middle = centre(first.pose);
    now.ego = {middle[0], middle[1], yaw(first.pose),
               std::max(0.0, static_cast<double>(first.longitudinal_velocity_mps)),
               static_cast<double>(first.acceleration_mps2),
               std::tan(static_cast<double>(first.front_wheel_angle_rad)) / car.wheel_base_m,
               car.vehicle_length_m, car.vehicle_width_m};
    lane(given, &now);
    for (const auto& object : given.objects()->objects) now.others.push_back(other(object));
    return now;
  }

  // The preferred lanes around the ego, with their limits; straight beyond their end.
  static void lane(const ranker::DataInterface& given, rcirl::Surroundings* now) {
    auto& points = now->line.points;
    auto& limits = now->line.speed_limit;
    for (const auto& lanelet : *given.preferred_lanes()) {
      for (const auto& point : lanelet.centerline()) {
        if (std::hypot(point.x() - now->ego.x, point.y() - now->ego.y) > kAroundM) continue;
        points.push_back({point.x(), point.y()});
        limits.push_back(lanelet.attributeOr("speed_limit", 50.0) / 3.6);
      }
    }
    if (points.size() < 2) return;  // `scene_from` says what is missing
    const XY last = points.back(), before = points[points.size() - 2];
    const double step = std::hypot(last[0] - before[0], last[1] - before[1]);
    const double more = kAroundM / std::max(step, 1e-3);
    points.push_back({last[0] + more * (last[0] - before[0]), last[1] + more * (last[1] - before[1])});
    limits.push_back(limits.back());
  }

  // The sizes of a shape, and the middle of its box. A cylinder has a diameter only; the
  // outline of a polygon stands in the object's frame, around a place of its own.
  template <typename Shape>
  static void box(const Shape& shape, rcirl::Other* made) {
    double length = shape.dimensions.x, width = shape.dimensions.y;
    if (shape.type == Shape::CYLINDER) width = length;
    if (shape.type == Shape::POLYGON && !shape.footprint.points.empty()) {
      const auto& first = shape.footprint.points.front();
      double low[2] = {first.x, first.y}, high[2] = {first.x, first.y};
      for (const auto& point : shape.footprint.points) {
        const double at[2] = {point.x, point.y};
        for (int i = 0; i < 2; ++i) {
          low[i] = std::min(low[i], at[i]), high[i] = std::max(high[i], at[i]);
        }
      }
      length = high[0] - low[0], width = high[1] - low[1];
      const double ahead = 0.5 * (low[0] + high[0]), left = 0.5 * (low[1] + high[1]);
      const double cosine = std::cos(made->heading), sine = std::sin(made->heading);
      made->x += cosine * ahead - sine * left, made->y += sine * ahead + cosine * left;
    }
    made->length = std::max(kLeastM, length), made->width = std::max(kLeastM, width);
  }

  template <typename Object>
  static rcirl::Other other(const Object& object) {
    using Label = std::decay_t<decltype(object.classification.front())>;
    const auto& pose = object.kinematics.initial_pose_with_covariance.pose;
    rcirl::Other made;
    made.x = pose.position.x, made.y = pose.position.y, made.heading = yaw(pose);
    made.speed = object.kinematics.initial_twist_with_covariance.twist.linear.x;
    box(object.shape, &made);
    float most = -1.0f;
    for (const auto& one : object.classification) {
      if (one.probability <= most) continue;
      most = one.probability;
      const bool cycles = one.label == Label::BICYCLE || one.label == Label::MOTORCYCLE;
      made.kind = one.label == Label::PEDESTRIAN ? rcirl::ObstacleKind::kPedestrian
                  : cycles                       ? rcirl::ObstacleKind::kCyclist
                                                 : rcirl::ObstacleKind::kVehicle;
    }
    return made;
  }

  rcirl::Reward reward_;
  rcirl::FeatureMap columns_;
  rcirl::Status status_;
  mutable bool told_ = false;  // that its place has no weight
};

}  // namespace rcirl_autoware

#endif  // RCIRL_ADAPTERS_AUTOWARE_REWARD_METRIC_HPP_
