// Text of numbers, as the lines of log and terminal have it.
#pragma once

#include <clocale>
#include <cstdarg>
#include <cstdio>
#include <cstdlib>
#include <optional>
#include <stdexcept>
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

// Refuse a locale with a decimal comma: numbers of messages would end there, and commands have commas between numbers.
inline void check_locale() {
  const std::string point = std::localeconv()->decimal_point;
  if (point == ".") return;
  throw std::runtime_error("this program's locale writes numbers with '" + point +
                           "': call std::setlocale(LC_NUMERIC, \"C\") first");
}

// Returns the number that a text is, all of it; none where it is anything else.
inline std::optional<double> number_in(const std::string& line) {
  char* end = nullptr;
  const double value = std::strtod(line.c_str(), &end);
  if (line.empty() || end != line.c_str() + line.size()) return std::nullopt;
  return value;
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
