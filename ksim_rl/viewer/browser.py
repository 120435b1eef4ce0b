"""The browser viewer serves a session on a port of this machine, through viser."""

import time
from collections.abc import Callable

import numpy as np
import viser

from ksim_rl.scene.viewer_cfg import ViewerCfg
from ksim_rl.viewer import guarded_server
from ksim_rl.viewer.browser_scene import BrowserScene, SceneOfEnv
from ksim_rl.viewer.gate import Gate, check_listens
from ksim_rl.viewer.pad import Pad
from ksim_rl.viewer.panel import Panel
from ksim_rl.viewer.plots import Plots
from ksim_rl.viewer.session import Session

FRAME_S = 1.0 / 30.0
# Seconds between two looks for a connected browser.
IDLE_S = 0.2


class BrowserViewer:
    """A server on `host`:`port`, or the next free port; it opens immediately and shows a session once it has one.

    Who opens `address` or `pad_address`, which hold a token, can drive; see `ksim_rl.viewer.gate` for who cannot.
    With the default host only this machine reaches the ports. Raises ValueError for a host or port that
    cannot be.
    """

    def __init__(
        self, *, host: str = "127.0.0.1", port: int = 8080, label: str = "ksim_rl"
    ) -> None:
        # Before the server is made, for an error in plain words.
        check_listens(host, port)
        self._gate = Gate(host)
        # The gate stands before viser: who has no token is refused there.
        self.server = guarded_server.start(self._gate, host=host, port=port, label=label)
        self.server.gui.configure_theme(show_share_button=False, show_logo=False)
        self.server.gui.main_panel.dock_right()
        self.port = self.server.get_port()
        self.address = self._gate.address(self.port)
        self._host = host
        # Shown while kernels compile, which may take minutes.
        self._notice = self.server.gui.add_markdown("building the env ...")
        self._session: Session | None = None

    @property
    def watched(self) -> bool:
        """Whether a browser is connected."""
        return bool(self.server.get_clients())

    @property
    def ignored(self) -> int:
        """How many messages of clients were none of the page's, or more than there was room for."""
        return self._gate.ignored

    def open(self, session: Session) -> None:
        """Show a session from now on."""
        self._session = session
        self._notice.remove()
        server = self.server
        cfg = session.ours.cfg.viewer
        # Before the first picture, so that the camera does not jump.
        _aim(server, cfg)
        self._panel = Panel(server.gui, session)
        # No tab: charts that are made while they are hidden stay empty.
        with server.gui.add_folder("Plots") as plots:
            self._plots = Plots(server.gui, plots, session)
        # One port further, so that both can be forwarded together.
        self._pad = Pad(
            self._panel,
            session,
            self._gate,
            host=self._host,
            port=self.port + 1,
            viewer_port=self.port,
        )
        self._built = 0
        self._scene: BrowserScene | None = None

    @property
    def pad_address(self) -> str:
        """Where the page for keyboard and gamepad is."""
        return self._pad.address

    def show(self) -> None:
        """Send the present state."""
        session = self._session
        assert session is not None
        # All widgets and meshes change in one frame of the browser.
        with self.server.atomic():
            # Another env may have another model: everything is drawn again.
            if session.built != self._built:
                self.server.scene.reset()
                self._built = session.built
                self._env_scene = SceneOfEnv(session.ours)
                self._scene = BrowserScene(self.server.scene, self._env_scene.mj_model)
            assert self._scene is not None
            self._env_scene.fill(
                session.env_index, drawn=self._panel.drawn, contacts=self._panel.contacts
            )
            if self._panel.follows:
                center = self._env_scene.center(session.ours.cfg.viewer.body)
            else:
                center = np.zeros(3)
            self._scene.show(self._env_scene.mjv, center=center)
            self._panel.show(ignored=self.ignored)
            self._plots.show()

    def run(self, *, goes_on: Callable[[], bool] = lambda: True) -> None:
        """Step the session and show it while `goes_on`; as long as no browser is connected, nothing happens."""
        session = self._session
        assert session is not None
        # The first picture goes to a browser that has just come, also while the session is paused.
        sent = False
        while goes_on():
            if not self.watched:
                # Time without a viewer must not be made up for.
                session.rest()
                sent = False
                time.sleep(IDLE_S)
                continue
            start = time.monotonic()
            changed = session.advance(self._plots.take)
            # Steps that requests made, such as a single step, are plotted too.
            self._plots.take()
            if changed or not sent:
                self.show()
                sent = True
            # A short sleep in any case: the threads of the connections need their turn.
            time.sleep(max(0.001, FRAME_S - (time.monotonic() - start)))

    def close(self) -> None:
        """Stop serving."""
        # The pad is opened with the session.
        if self._session is not None:
            self._pad.close()
        self.server.stop()


def _aim(server: viser.ViserServer, cfg: ViewerCfg) -> None:
    """Look from where the pictures of videos are taken."""
    azimuth = np.radians(cfg.azimuth)
    elevation = np.radians(cfg.elevation)
    ahead = np.array(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
    )
    # Above the origin: the scene is moved so that the robot stands there.
    target = np.array([0.0, 0.0, cfg.lookat[2]])
    server.initial_camera.look_at = target
    server.initial_camera.position = target - cfg.distance * ahead
