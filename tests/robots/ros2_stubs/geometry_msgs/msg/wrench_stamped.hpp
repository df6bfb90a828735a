// Stub of geometry_msgs/msg/wrench_stamped.hpp: see ../../README.md.
#pragma once
#include <cstdint>
#include <memory>
#include <string>

namespace std_msgs::msg
{
struct Header
{
  struct {std::int32_t sec = 0; std::uint32_t nanosec = 0;} stamp;
  std::string frame_id;
};
}  // namespace std_msgs::msg

namespace geometry_msgs::msg
{
struct Vector3 {double x = 0.0, y = 0.0, z = 0.0;};
struct Wrench {Vector3 force, torque;};
struct WrenchStamped {std_msgs::msg::Header header; Wrench wrench;};
}  // namespace geometry_msgs::msg
