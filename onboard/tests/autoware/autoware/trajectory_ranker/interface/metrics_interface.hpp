// A stand-in for the headers of Autoware that adapters/autoware reads: the same names and
// types, as far as they are used, and nothing else.
#ifndef RCIRL_TESTS_AUTOWARE_METRICS_INTERFACE_HPP_
#define RCIRL_TESTS_AUTOWARE_METRICS_INTERFACE_HPP_

#include <cstddef>
#include <cstdint>
#include <iostream>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#define RCLCPP_ERROR_STREAM(logger, message) (std::cerr << (logger) << ": " << (message) << '\n')

namespace rclcpp {
inline std::string get_logger(const std::string& name) { return name; }
}  // namespace rclcpp

namespace stand_in {

struct Duration {
  std::int32_t sec = 0;
  std::uint32_t nanosec = 0;
};

struct Vector {
  double x = 0.0, y = 0.0, z = 0.0;
};

struct Quaternion {
  double x = 0.0, y = 0.0, z = 0.0, w = 1.0;
};

struct Pose {
  Vector position;
  Quaternion orientation;
};

struct Twist {
  Vector linear, angular;
};

struct PoseWithCovariance {
  Pose pose;
};

struct TwistWithCovariance {
  Twist twist;
};

struct TrajectoryPoint {
  Duration time_from_start;
  Pose pose;
  float longitudinal_velocity_mps = 0.0f, lateral_velocity_mps = 0.0f;
  float acceleration_mps2 = 0.0f, heading_rate_rps = 0.0f;
  float front_wheel_angle_rad = 0.0f, rear_wheel_angle_rad = 0.0f;
};

struct ObjectClassification {
  enum : std::uint8_t { UNKNOWN, CAR, TRUCK, BUS, TRAILER, MOTORCYCLE, BICYCLE, PEDESTRIAN };
  std::uint8_t label = UNKNOWN;
  float probability = 0.0f;
};

struct Kinematics {
  PoseWithCovariance initial_pose_with_covariance;
  TwistWithCovariance initial_twist_with_covariance;
};

struct Point32 {
  float x = 0.0f, y = 0.0f, z = 0.0f;
};

struct Polygon {
  std::vector<Point32> points;
};

struct Shape {
  enum : std::uint8_t { BOUNDING_BOX, CYLINDER, POLYGON };
  std::uint8_t type = BOUNDING_BOX;
  Polygon footprint;
  Vector dimensions;
};

struct PredictedObject {
  std::vector<ObjectClassification> classification;
  Kinematics kinematics;
  Shape shape;
};

struct PredictedObjects {
  std::vector<PredictedObject> objects;
};

}  // namespace stand_in

namespace lanelet {

class ConstPoint3d {
 public:
  ConstPoint3d(double x, double y) : x_(x), y_(y) {}
  double x() const { return x_; }
  double y() const { return y_; }

 private:
  double x_, y_;
};

struct ConstLanelet {
  std::vector<ConstPoint3d> points;
  double speed_limit = 0.0;  // km/h; 0: the map has none

  const std::vector<ConstPoint3d>& centerline() const { return points; }
  double attributeOr(const std::string& name, double otherwise) const {
    return name == "speed_limit" && speed_limit > 0.0 ? speed_limit : otherwise;
  }
};

using ConstLanelets = std::vector<ConstLanelet>;

}  // namespace lanelet

namespace autoware::vehicle_info_utils {

struct VehicleInfo {
  double wheel_base_m = 0.0, vehicle_length_m = 0.0, vehicle_width_m = 0.0;
  double min_longitudinal_offset_m = 0.0, max_longitudinal_offset_m = 0.0;
};

}  // namespace autoware::vehicle_info_utils

namespace autoware::trajectory_ranker {

using TrajectoryPoints = std::vector<stand_in::TrajectoryPoint>;

class DataInterface {
 public:
  std::shared_ptr<TrajectoryPoints> points() const { return points_; }
  std::shared_ptr<stand_in::PredictedObjects> objects() const { return objects_; }
  std::shared_ptr<lanelet::ConstLanelets> preferred_lanes() const { return lanes_; }
  void set_metric(std::size_t index, const std::vector<float>& metric) {
    metrics_.resize(index + 1);
    metrics_[index] = metric;
  }

  // of the test
  const std::vector<float>& metric(std::size_t index) const { return metrics_.at(index); }

 private:
  std::shared_ptr<TrajectoryPoints> points_ = std::make_shared<TrajectoryPoints>();
  std::shared_ptr<stand_in::PredictedObjects> objects_ =
      std::make_shared<stand_in::PredictedObjects>();
  std::shared_ptr<lanelet::ConstLanelets> lanes_ = std::make_shared<lanelet::ConstLanelets>();
  std::vector<std::vector<float>> metrics_;
};

namespace metrics {

class MetricInterface {
 public:
  explicit MetricInterface(std::string name) : name_(std::move(name)) {}
  virtual ~MetricInterface() = default;

  virtual void evaluate(const std::shared_ptr<DataInterface>& result,
                        const float max_value) const = 0;
  virtual bool is_deviation() const = 0;

  void init(const std::shared_ptr<vehicle_info_utils::VehicleInfo>& info, const float resolution) {
    info_ = info;
    resolution_ = resolution;
  }
  void set_index(std::size_t index) { index_ = index; }
  std::string name() const { return name_; }
  std::size_t index() const { return index_; }

 protected:
  std::shared_ptr<vehicle_info_utils::VehicleInfo> vehicle_info() const { return info_; }
  float resolution() const { return resolution_; }

 private:
  std::shared_ptr<vehicle_info_utils::VehicleInfo> info_;
  std::string name_;
  std::size_t index_ = 0;
  float resolution_ = 0.0f;
};

}  // namespace metrics

}  // namespace autoware::trajectory_ranker

#endif  // RCIRL_TESTS_AUTOWARE_METRICS_INTERFACE_HPP_
