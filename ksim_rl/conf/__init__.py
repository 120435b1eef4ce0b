"""Composes the config of `ksim-rl train` with Hydra, from YAML, the dataclasses and the registered parts."""

from ksim_rl.conf import spelling
from ksim_rl.conf.command_line import (
    changed,
    check_command_line,
    check_composed,
    compose,
    fields_of,
    without_sweeps,
)
from ksim_rl.conf.help_page import completions, help_page
from ksim_rl.conf.own_files import check_files_not_replaced, naming_files, own_files
from ksim_rl.conf.registration import (
    MODULE,
    NAME,
    RUN_AGAIN,
    RUN_CONFIG,
    check_groups,
    register,
    register_run,
    searched_folders,
)
