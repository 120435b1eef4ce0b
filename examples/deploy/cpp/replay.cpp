// Answers messages of a robot with the commands of the loop, a line for each: what the loop does can be compared with
// loop.py, message by message, in no time of anybody's.
//
//   replay FOLDER [--stand-seconds 0.4 ...] < messages
//
// A message is `TIME WORDS STAMP COUNT POS VEL EFFORT QUAT ANG_VEL [NAME=NUMBERS]...`: times in s, lists with commas, `-`
// for what is not there, and STAMP `-` for no measurement; WORDS are an operator's, with commas, and _ for blanks. The
// answer is lines with # for what happened, and `STATE POS VEL EFFORT STIFFNESS DAMPING`.

#include <iostream>
#include <sstream>

#include "options.h"
#include "states.h"
#include "words.h"

namespace ksim {

double now_of_replay = 0.0;  // the time of the message that is answered

Names parts_of(const std::string& line, char mark) {
  Names parts;
  std::istringstream stream(line);
  for (std::string part; std::getline(stream, part, mark);) parts.push_back(part);
  return parts;
}

Numbers numbers_in(const std::string& list) {
  Numbers found;
  for (const auto& part : parts_of(list, ',')) found.push_back(std::strtod(part.c_str(), nullptr));
  return found;
}

std::optional<Numbers> optional_numbers(const std::string& list) {
  if (list == "-") return std::nullopt;
  return numbers_in(list);
}

std::optional<Measurement> measurement_of(const Names& fields) {
  if (fields[2] == "-") return std::nullopt;
  Measurement found;
  found.stamp = std::strtod(fields[2].c_str(), nullptr);
  if (fields[3] != "-") found.count = std::strtoll(fields[3].c_str(), nullptr, 10);
  found.joint_pos = numbers_in(fields[4]);
  found.joint_vel = numbers_in(fields[5]);
  found.joint_effort = numbers_in(fields[6]);
  found.root_quat = optional_numbers(fields[7]);
  found.root_ang_vel = optional_numbers(fields[8]);
  for (size_t k = 9; k < fields.size(); ++k) {
    const size_t mark = fields[k].find('=');
    found.estimates[fields[k].substr(0, mark)] = numbers_in(fields[k].substr(mark + 1));
  }
  return found;
}

Names words_of(const std::string& field) {
  if (field == "-") return {};
  Names words = parts_of(field, ',');
  for (auto& word : words) std::replace(word.begin(), word.end(), '_', ' ');
  return words;
}

std::string listed(const Numbers& values) {
  std::string line;
  for (double value : values) line += text(line.empty() ? "%.17g" : ",%.17g", value);
  return line;
}

int replay(const Options& options) {
  PolicyControl control(options.folder, read_json(options.folder + "/export.json"));
  const double period = control.step_dt;
  const auto time = [] { return now_of_replay; };
  DryRun dry(control, period, options.times.dry_seconds, options.limits.position_margin, time);
  const auto note = [](double, const std::string& line) { std::cout << "# " << line << "\n"; };
  StateMachine machine(control, dry, period, options.limits, options.times, note);
  for (std::string line; std::getline(std::cin, line);) {
    const Names fields = parts_of(line, ' ');
    if (fields.size() < 9) throw std::runtime_error("a message of " + text("%zu fields", fields.size()));
    now_of_replay = std::strtod(fields[0].c_str(), nullptr);
    const Names words = sort_words(words_of(fields[1]), machine, now_of_replay);
    const JointCommand command = machine.tick(now_of_replay, measurement_of(fields), words);
    std::cout << name_of(machine.state);
    for (const Numbers* values : {&command.pos, &command.vel, &command.effort, &command.stiffness, &command.damping}) {
      std::cout << " " << listed(*values);
    }
    std::cout << std::endl;
  }
  return machine.fault.empty() ? 0 : 1;
}

}  // namespace ksim

int main(int count, char** arguments) try {
  return ksim::replay(ksim::parse_options(count, arguments));
} catch (const std::exception& error) {
  std::cerr << "replay: error: " << error.what() << "\n";
  return 2;
}
