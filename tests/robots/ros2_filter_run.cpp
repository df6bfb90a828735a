// Runs the exported filter on lines of `sec nanosec imu(0/1) s(3) omega(3) wrench(6)`.
// Arguments: name=value parameters; the word `tare` calls the service before the first line.
#include <cstdio>
#include <cstring>

#include "filters/filter_base.hpp"
#include "sensor_msgs/msg/imu.hpp"
#include "std_srvs/srv/trigger.hpp"

using Wrench = geometry_msgs::msg::WrenchStamped;
using Imu = sensor_msgs::msg::Imu;
using Trigger = std_srvs::srv::Trigger;
std::unique_ptr<filters::FilterBase<Wrench>> make_plugin();

int main(int count, char ** arguments)
{
  auto parameters = std::make_shared<rclcpp::node_interfaces::NodeParametersInterface>();
  parameters->values["chain.params.imu_topic"] = rclcpp::ParameterValue(std::string("/wrist"));
  bool tare = false;
  for (int k = 1; k < count; ++k) {
    const std::string text = arguments[k];
    const auto equal = text.find('=');
    const std::string name = "chain.params." + text.substr(0, equal);
    if (text == "tare") {
      tare = true;
    } else if (text == "scaled") {
      parameters->values[name] = rclcpp::ParameterValue(true);
    } else {
      parameters->values[name] = rclcpp::ParameterValue(std::stod(text.substr(equal + 1)));
    }
  }
  auto plugin = make_plugin();
  Wrench in, out;
  if (plugin->update(in, out)) {return 3;}  // not configured
  if (!plugin->configure("chain.params", "contact", nullptr, parameters)) {return 4;}
  auto motion = std::any_cast<rclcpp::Subscription<Imu>::SharedPtr>(rclcpp::created.at("/wrist"));
  auto service =
    std::any_cast<rclcpp::Service<Trigger>::SharedPtr>(rclcpp::created.at("contact_motion/tare"));
  if (tare) {
    auto response = std::make_shared<Trigger::Response>();
    service->callback(std::make_shared<Trigger::Request>(), response);
    if (!response->success) {return 5;}
  }
  in.header.frame_id = "ft_sensor";
  int sec, received;
  unsigned nanosec;
  while (std::scanf("%d %u %d", &sec, &nanosec, &received) == 3) {
    double x[12];
    for (double & value : x) {
      if (std::scanf("%lf", &value) != 1) {return 2;}
    }
    if (received) {
      auto imu = std::make_shared<Imu>();
      imu->header.stamp.sec = sec;
      imu->header.stamp.nanosec = nanosec;
      imu->linear_acceleration = {x[0], x[1], x[2]};
      imu->angular_velocity = {x[3], x[4], x[5]};
      motion->callback(imu);
    }
    in.wrench = {{x[6], x[7], x[8]}, {x[9], x[10], x[11]}};
    if (!plugin->update(in, out) || out.header.frame_id != "ft_sensor") {return 6;}
    const auto & f = out.wrench.force;
    const auto & tau = out.wrench.torque;
    std::printf(
      "%.17g %.17g %.17g %.17g %.17g %.17g\n", f.x, f.y, f.z, tau.x, tau.y, tau.z);
  }
}
