// Stub of filters/filter_base.hpp: see ../README.md.
#pragma once
#include <string>

#include "rclcpp/rclcpp.hpp"

namespace filters
{
template<typename T>
class FilterBase
{
public:
  virtual ~FilterBase() = default;
  bool configure(
    const std::string & param_prefix, const std::string & filter_name,
    const rclcpp::node_interfaces::NodeLoggingInterface::SharedPtr & node_logger,
    const rclcpp::node_interfaces::NodeParametersInterface::SharedPtr & node_params)
  {
    filter_name_ = filter_name;
    param_prefix_ = param_prefix + ".";
    logging_interface_ = node_logger;
    params_interface_ = node_params;
    return configured_ = configure();
  }
  virtual bool update(const T & data_in, T & data_out) = 0;

protected:
  virtual bool configure() = 0;
  std::string filter_name_, param_prefix_;
  bool configured_ = false;
  rclcpp::node_interfaces::NodeLoggingInterface::SharedPtr logging_interface_;
  rclcpp::node_interfaces::NodeParametersInterface::SharedPtr params_interface_;
};
}  // namespace filters
