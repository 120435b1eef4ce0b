"""Families of payloads in run folders of strangers: what writes each one, and what removes the check that stops it."""

from tests.cli.payloads import configs, files, groups  # each registers its families
from tests.cli.payloads.configs import without_the_check_of_config as without_the_check_of_config
from tests.cli.payloads.files import Bomb as Bomb
from tests.cli.payloads.files import with_pickles as with_pickles
from tests.cli.payloads.place import FAMILIES as FAMILIES
from tests.cli.payloads.place import SECRET as SECRET
from tests.cli.payloads.place import SMALL as SMALL
from tests.cli.payloads.place import Place as Place
from tests.cli.payloads.place import as_a_run_would as as_a_run_would
from tests.cli.payloads.place import call as call
from tests.cli.payloads.place import signs as signs
