// Words of an operator: stand, policy, stop, damp, and numbers of a command.
#pragma once

#include <atomic>
#include <csignal>
#include <iostream>
#include <mutex>
#include <sstream>
#include <thread>

#include "states.h"

namespace ksim {

// Lines of a terminal: each is a word, or the numbers of a command; an empty line is `stop`. The end of lines is `stop`,
// too, where the keyboard leads: no word could stop the robot any more.
class Keyboard {
 public:
  explicit Keyboard(bool leads) {
    // It may still wait for a line when the program ends, so it is not joined, and it holds only static data.
    std::thread([leads] { listen(leads); }).detach();
  }

  Names words() {
    const std::lock_guard<std::mutex> lock(mutex());
    Names found;
    found.swap(said());
    return found;
  }

 private:
  static void listen(bool leads) {
    std::string line;
    while (std::getline(std::cin, line)) say(trimmed(line));
    if (leads) say("stop");
  }

  static std::string trimmed(const std::string& line) {
    const size_t first = line.find_first_not_of(" \t\r");
    if (first == std::string::npos) return "stop";
    return line.substr(first, line.find_last_not_of(" \t\r") - first + 1);
  }

  static void say(const std::string& word) {
    const std::lock_guard<std::mutex> lock(mutex());
    said().push_back(word);
  }

  static std::mutex& mutex() {
    static auto* const kept = new std::mutex;
    return *kept;
  }

  static Names& said() {
    static auto* const kept = new Names;
    return *kept;
  }
};

// Makes `stop` of the first interrupt or end that the system sends to this process, and `damp` of the next.
class Interrupts {
 public:
  Interrupts() {
    for (int number : {SIGINT, SIGTERM, SIGHUP, SIGQUIT, SIGTSTP}) std::signal(number, heard);
    // By these a system halts a program in the background that uses the terminal; a broken pipe would end it.
    for (int number : {SIGTTIN, SIGTTOU, SIGPIPE}) std::signal(number, SIG_IGN);
  }

  Names words() {
    Names found;
    for (; said_ < count(); ++said_) found.push_back(said_ == 0 ? "stop" : "damp");
    return found;
  }

 private:
  static std::atomic<int>& count() {
    static std::atomic<int> kept{0};
    return kept;
  }

  static void heard(int) { ++count(); }

  int said_ = 0;
};

// Says what leads from one state to the next: stand after a rest, policy, and stop after some seconds of it.
class Unattended {
 public:
  explicit Unattended(double seconds) : seconds_(seconds) {}

  Names words(double now, const StateMachine& machine) {
    if (!machine.fault.empty() || machine.ends_at < infinity) return {};
    if (std::isnan(began_)) began_ = now;
    if (machine.state == State::damp && now - began_ >= rest) return {"stand"};
    if (machine.may_begin(now)) return {"policy"};
    if (machine.state == State::policy && now - machine.since >= seconds_) return {"stop"};
    return {};
  }

 private:
  static constexpr double rest = 1.0;
  double seconds_;
  double began_ = std::nan("");
};

// Returns the numbers of a line; none where a part of it is no number.
inline std::optional<Numbers> numbers_of(const std::string& line) {
  std::istringstream parts(line);
  Numbers values;
  for (std::string part; parts >> part;) {
    const std::optional<double> value = number_in(part);
    if (!value) return std::nullopt;
    values.push_back(*value);
  }
  return values;
}

// Returns the words among what was said, and takes over what are numbers of the policy's first command.
inline Names sort_words(const Names& said, StateMachine& machine, double now) {
  Names found;
  for (const auto& line : said) {
    const std::optional<Numbers> values = numbers_of(line);
    if (!values) {
      found.push_back(line);
      continue;
    }
    auto& commands = machine.control.commands;
    const size_t wanted = commands.empty() ? 0 : commands[0].values.size();
    const auto is_finite = [](double value) { return std::isfinite(value); };
    if (commands.empty() || values->size() != wanted || !std::all_of(values->begin(), values->end(), is_finite)) {
      machine.note(now, "operator: '" + line + text("': expected %zu numbers", wanted));
      continue;
    }
    Command& command = commands[0];
    const Numbers clipped = command.clip(*values);
    // A stick that is held beyond the range says so once.
    if (clipped != command.values) {
      const std::string beyond = clipped == *values ? "" : ": clipped to " + command.range();
      machine.note(now, "operator: " + command.name + " " + line + beyond);
    }
    command.values = clipped;
  }
  return found;
}

}  // namespace ksim
