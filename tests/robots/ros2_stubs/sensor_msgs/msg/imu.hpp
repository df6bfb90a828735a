// Stub of sensor_msgs/msg/imu.hpp: see ../../README.md.
#pragma once
#include "geometry_msgs/msg/wrench_stamped.hpp"

namespace sensor_msgs::msg
{
struct Imu
{
  using ConstSharedPtr = std::shared_ptr<const Imu>;
  std_msgs::msg::Header header;
  geometry_msgs::msg::Vector3 angular_velocity, linear_acceleration;
};
}  // namespace sensor_msgs::msg
