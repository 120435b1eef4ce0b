"""This module lets Hydra find the YAML configs of other packages (see `ksim_rl.config.plugins`)."""

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.search_path_plugin import SearchPathPlugin

from ksim_rl.config import plugins


class DeclaredConfigs(SearchPathPlugin):
    """Appends each package that declares configs; ours come first."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append them."""
        for origin, package in plugins.conf_packages():
            search_path.append(provider=f"ksim_rl.conf:{origin}", path=f"pkg://{package}")


def register() -> None:
    """Make Hydra ask `DeclaredConfigs` from now on."""
    Plugins.instance().register(DeclaredConfigs)
