// Text of numbers, as the lines of log and terminal have it.
#pragma once

#include <cstdarg>
#include <cstdio>
#include <string>
#include <vector>

namespace ksim {

using Numbers = std::vector<double>;
using Names = std::vector<std::string>;

// Returns what printf would print.
__attribute__((format(printf, 1, 2))) inline std::string text(const char* form, ...) {
  char line[1024];
  va_list values;
  va_start(values, form);
  std::vsnprintf(line, sizeof line, form, values);
  va_end(values);
  return line;
}

// Returns names with a comma between each two.
inline std::string joined(const Names& names) {
  std::string line;
  for (const auto& name : names) {
    if (!line.empty()) line += ", ";
    line += name;
  }
  return line;
}

// Returns numbers as an operator would say them.
inline std::string as_words(const Numbers& values) {
  std::string line;
  for (double value : values) {
    if (!line.empty()) line += " ";
    line += text("%g", value);
  }
  return line;
}

}  // namespace ksim
