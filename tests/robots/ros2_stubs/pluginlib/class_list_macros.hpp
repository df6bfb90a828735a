// Stub of pluginlib/class_list_macros.hpp: see ../README.md. It checks that the base fits.
#pragma once
#include <memory>

#define PLUGINLIB_EXPORT_CLASS(Class, Base) \
  std::unique_ptr<Base> make_plugin() {return std::make_unique<Class>();}
