// Filter of geometry_msgs/WrenchStamped: removes weight and inertia of the load in load.h.
//
// The motion of the sensor comes from a sensor_msgs/Imu in the frame of the sensor.
#include <array>
#include <atomic>
#include <cmath>
#include <memory>
#include <mutex>
#include <string>
#include <thread>

#include "filters/filter_base.hpp"
#include "geometry_msgs/msg/wrench_stamped.hpp"
#include "load.h"
#include "pluginlib/class_list_macros.hpp"
#include "rclcpp/rclcpp.hpp"
#include "sensor_msgs/msg/imu.hpp"
#include "std_srvs/srv/trigger.hpp"

namespace wrench_compensator_filter
{
using Wrench = geometry_msgs::msg::WrenchStamped;
using Imu = sensor_msgs::msg::Imu;
using Trigger = std_srvs::srv::Trigger;

class WrenchCompensatorFilter : public filters::FilterBase<Wrench>
{
public:
  ~WrenchCompensatorFilter() override {stop();}

  bool update(const Wrench & in, Wrench & out) override
  {
    if (!configured_) {
      return false;
    }
    // The real-time loop does not wait for the subscription; it takes the motion next time.
    if (std::unique_lock<std::mutex> lock{mutex_, std::try_to_lock}; lock && new_motion_) {
      motion_ = received_;
      new_motion_ = false;
      steps_without_motion_ = 0;
    } else if (++steps_without_motion_ > compensator_.settings.stale_steps) {
      motion_.fill(std::nan(""));  // invalid: zero wrench, and a restart of low-pass and tare
      steps_without_motion_ = compensator_.settings.stale_steps;
    }
    if (tare_.exchange(false)) {
      wrench_compensator_tare(&compensator_);
    }
    const auto & f = in.wrench.force;
    const auto & tau = in.wrench.torque;
    const std::array<double, 6> wrench{sign_ * f.x, sign_ * f.y, sign_ * f.z,
      sign_ * tau.x, sign_ * tau.y, sign_ * tau.z};
    std::array<double, 6> contact{}, scaled{};
    wrench_compensator_step(
      &compensator_, wrench.data(), motion_.data(), motion_.data() + 3, motion_.data() + 6,
      nullptr, contact.data(), scaled.data());
    const auto & result = scaled_ ? scaled : contact;
    out.header = in.header;
    out.wrench.force.x = sign_ * result[0];
    out.wrench.force.y = sign_ * result[1];
    out.wrench.force.z = sign_ * result[2];
    out.wrench.torque.x = sign_ * result[3];
    out.wrench.torque.y = sign_ * result[4];
    out.wrench.torque.z = sign_ * result[5];
    return true;
  }

protected:
  bool configure() override
  {
    stop();
    wrench_compensator_settings settings = wrench_compensator_load;
    settings.sigma_weight = settings.sigma_inertia = parameter("sigma", 0.0);
    settings.gamma = parameter("gamma", 1.0);
    scaled_ = parameter("scaled", false);
    sign_ = parameter("sign", WRENCH_COMPENSATOR_SIGN);
    wrench_compensator_init(&compensator_, &settings);
    steps_without_motion_ = settings.stale_steps;
    node_ = std::make_shared<rclcpp::Node>(filter_name_ + "_motion");
    subscription_ = node_->create_subscription<Imu>(
      parameter("imu_topic", std::string("imu")), rclcpp::SensorDataQoS(),
      [this](const Imu::ConstSharedPtr imu) {receive(*imu);});
    service_ = node_->create_service<Trigger>(
      "~/tare", [this](const Trigger::Request::SharedPtr, Trigger::Response::SharedPtr response) {
        tare_ = true;
        response->success = true;
        response->message = "started; it needs rest and no contact";
      });
    executor_ = std::make_unique<rclcpp::executors::SingleThreadedExecutor>();
    executor_->add_node(node_);
    thread_ = std::thread([this] {executor_->spin();});
    return true;
  }

private:
  template<typename T>
  T parameter(const std::string & name, const T & otherwise)
  {
    const std::string full = param_prefix_ + name;
    if (!params_interface_->has_parameter(full)) {
      params_interface_->declare_parameter(full, rclcpp::ParameterValue(otherwise));
    }
    return params_interface_->get_parameter(full).get_parameter_value().get<T>();
  }

  void receive(const Imu & imu)
  {
    const auto & s = imu.linear_acceleration;
    const auto & w = imu.angular_velocity;
    const double t = imu.header.stamp.sec + 1e-9 * imu.header.stamp.nanosec;
    const std::array<double, 3> omega{w.x, w.y, w.z};
    std::array<double, 3> alpha{};
    if (t > last_t_ && t - last_t_ < MAX_PERIOD_S) {
      for (std::size_t i = 0; i < 3; ++i) {
        alpha[i] = (omega[i] - last_omega_[i]) / (t - last_t_);
      }
    }
    last_t_ = t;
    last_omega_ = omega;
    const std::lock_guard<std::mutex> lock{mutex_};
    received_ = {s.x, s.y, s.z, omega[0], omega[1], omega[2], alpha[0], alpha[1], alpha[2]};
    new_motion_ = true;
  }

  void stop()
  {
    if (thread_.joinable()) {
      executor_->cancel();
      thread_.join();
    }
  }

  static constexpr double MAX_PERIOD_S = 0.05;  // between two messages that give an acceleration

  wrench_compensator compensator_{};
  bool scaled_ = false;
  double sign_ = WRENCH_COMPENSATOR_SIGN;
  int steps_without_motion_ = 0;
  std::array<double, 9> motion_{};
  std::atomic<bool> tare_{false};

  std::mutex mutex_;  // guards the next two
  std::array<double, 9> received_{};
  bool new_motion_ = false;

  double last_t_ = -1.0;
  std::array<double, 3> last_omega_{};

  rclcpp::Node::SharedPtr node_;
  rclcpp::Subscription<Imu>::SharedPtr subscription_;
  rclcpp::Service<Trigger>::SharedPtr service_;
  std::unique_ptr<rclcpp::executors::SingleThreadedExecutor> executor_;
  std::thread thread_;
};
}  // namespace wrench_compensator_filter

PLUGINLIB_EXPORT_CLASS(
  wrench_compensator_filter::WrenchCompensatorFilter,
  filters::FilterBase<geometry_msgs::msg::WrenchStamped>)
