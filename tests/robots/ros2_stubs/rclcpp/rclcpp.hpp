// Stub of rclcpp/rclcpp.hpp: see ../README.md. Callbacks are called by the test.
#pragma once
#include <any>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <variant>

namespace rclcpp
{
class ParameterValue
{
public:
  ParameterValue() = default;
  explicit ParameterValue(bool value) : value_(value) {}
  explicit ParameterValue(double value) : value_(value) {}
  explicit ParameterValue(const std::string & value) : value_(value) {}
  template<typename T> const T & get() const {return std::get<T>(value_);}

private:
  std::variant<bool, double, std::string> value_;
};

class Parameter
{
public:
  explicit Parameter(const ParameterValue & value) : value_(value) {}
  const ParameterValue & get_parameter_value() const {return value_;}

private:
  ParameterValue value_;
};

namespace node_interfaces
{
struct NodeLoggingInterface
{
  using SharedPtr = std::shared_ptr<NodeLoggingInterface>;
};

struct NodeParametersInterface
{
  using SharedPtr = std::shared_ptr<NodeParametersInterface>;
  std::map<std::string, ParameterValue> values;
  bool has_parameter(const std::string & name) const {return values.count(name) > 0;}
  const ParameterValue & declare_parameter(const std::string & name, const ParameterValue & value)
  {
    return values[name] = value;
  }
  Parameter get_parameter(const std::string & name) const {return Parameter(values.at(name));}
};
}  // namespace node_interfaces

struct SensorDataQoS {};

template<typename T>
struct Subscription
{
  using SharedPtr = std::shared_ptr<Subscription>;
  std::function<void(std::shared_ptr<const T>)> callback;
};

template<typename T>
struct Service
{
  using SharedPtr = std::shared_ptr<Service>;
  std::function<void(std::shared_ptr<typename T::Request>, std::shared_ptr<typename T::Response>)>
  callback;
};

inline std::map<std::string, std::any> created;  // what the plugin has created, by topic or name

struct Node
{
  using SharedPtr = std::shared_ptr<Node>;
  explicit Node(const std::string & name) : name_(name) {}
  template<typename T, typename F>
  typename Subscription<T>::SharedPtr create_subscription(
    const std::string & topic, const SensorDataQoS &, F && callback)
  {
    auto made = std::make_shared<Subscription<T>>(Subscription<T>{callback});
    created[topic] = made;
    return made;
  }
  template<typename T, typename F>
  typename Service<T>::SharedPtr create_service(const std::string & name, F && callback)
  {
    auto made = std::make_shared<Service<T>>(Service<T>{callback});
    created[name_ + name.substr(1)] = made;
    return made;
  }

private:
  std::string name_;
};

namespace executors
{
struct SingleThreadedExecutor
{
  void add_node(const Node::SharedPtr &) {}
  void spin() {}
  void cancel() {}
};
}  // namespace executors
}  // namespace rclcpp
