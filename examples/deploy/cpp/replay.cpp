// Answers messages of a robot with the commands of the loop, a line for each: what the loop does can be compared with
// loop.py, message by message, in no time of anybody's.
//
//   replay FOLDER [--stand-seconds 0.4 ...] < messages
//
// A message is `TIME WORDS STAMP`, times in s, and what `measurement_of` reads; STAMP is `-` for no measurement. WORDS
// are an operator's, with commas, and _ for blanks. The answer is lines with # for what happened, and `STATE POS VEL
// EFFORT STIFFNESS DAMPING`.

#include <iostream>

#include "messages.h"
#include "options.h"
#include "states.h"
#include "words.h"

namespace ksim {

double now_of_replay = 0.0;  // the time of the message that is answered

Names words_of(const std::string& field) {
  if (field == "-") return {};
  Names words = split(field, ',');
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
    const Names fields = fields_of(line);
    if (fields.size() < 3) throw std::runtime_error("a message of " + text("%zu fields", fields.size()));
    now_of_replay = numbers_in("TIME", fields[0]).at(0);
    const Names words = sort_words(words_of(fields[1]), machine, now_of_replay);
    std::optional<Measurement> measurement;
    damping_after("read", machine, now_of_replay, [&] {
      if (fields[2] != "-") measurement = measurement_of(fields, 3, numbers_in("STAMP", fields[2]).at(0));
    });
    const JointCommand command = machine.tick(now_of_replay, measurement, words);
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
