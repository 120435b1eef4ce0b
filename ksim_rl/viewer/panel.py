"""The panel beside the scene holds the controls of a session, in viser's widgets."""

import dataclasses
from collections.abc import Mapping
from functools import partial

import viser

from ksim_rl.scene.motions.motion import ReferenceMotion
from ksim_rl.viewer.session import SPEEDS, Conditions, Session
from ksim_rl.viewer.shown_text import as_html, paragraph

_SPEED_NAMES = {
    ("1/8", "1/4", "1/2", "1", "2", "4", "8")[i]: speed for i, speed in enumerate(SPEEDS)
}


class Panel:
    """Shows how a session goes, and turns clicks into its requests.

    Attributes:
        follows: whether the camera follows the robot.
        contacts: whether contact points are drawn.
        drawn: the names of the drawings for debugging.
        push_speed: how hard a push is, m/s.
    """

    def __init__(self, gui: viser.GuiApi, session: Session) -> None:
        self._gui = gui
        self._session = session
        self.follows = True
        self.contacts = False
        self.drawn: set[str] = set()
        self._steering: dict[
            str, tuple[viser.GuiCheckboxHandle, dict[str, viser.GuiSliderHandle]]
        ] = {}
        self._status = gui.add_html("")
        self._error = gui.add_html("", visible=False)
        self._play = gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        # Widgets are called in threads of the server, so all that touches the env goes through `ask`.
        self._play.on_click(lambda _: session.ask(session.toggle))
        runs = gui.add_button_group("Run", ("Step", "Reset"))
        calls = {"Step": session.step_once, "Reset": session.reset}
        runs.on_click(lambda event: session.ask(calls[str(_value(event))]))
        self._speed = gui.add_button_group("Speed", tuple(_SPEED_NAMES))
        # A plain number, read between steps: no request is needed.
        self._speed.on_click(
            lambda event: setattr(session, "speed", _SPEED_NAMES[str(_value(event))])
        )
        self._env = gui.add_number("Env", 0, min=0, max=session.ours.num_envs - 1, step=1)
        self._env.on_update(lambda _: session.ask(partial(session.choose, int(self._env.value))))
        follow = gui.add_checkbox("Camera follows", True)
        follow.on_update(lambda _: setattr(self, "follows", follow.value))
        self.push_speed = gui.add_slider("Push (m/s)", 0.1, 3.0, 0.1, 1.0)
        push = gui.add_button("Push", icon=viser.Icon.HAND_MOVE)
        push.on_click(lambda _: session.ask(partial(session.push, float(self.push_speed.value))))
        motion = session.motion
        self._scrubber: tuple[viser.GuiDropdownHandle[str], viser.GuiSliderHandle[float]] | None
        self._scrubber = None
        if motion is not None:
            with gui.add_folder("Motion"):
                self._scrubber = self._add_scrubber(motion.motion)
        self._action: list[viser.GuiSliderHandle[float]] = []
        if session.driver is not None:
            with gui.add_folder("Action"):
                self._add_action(session.driver.ranges)
        # Commands without ranges cannot be set by hand.
        steerable = {name: term for name, term in session.ours.cfg.commands.items() if term.ranges}
        if steerable:
            with gui.add_folder("Commands"):
                for name, term in steerable.items():
                    # Names of commands only where there are several.
                    self._add_command(
                        name, term.ranges, prefix=f"{name}." if len(steerable) > 1 else ""
                    )
        with gui.add_folder("Conditions", expand_by_default=False):
            for field in dataclasses.fields(Conditions):
                self._add_condition(field.name)
        with gui.add_folder("Draw", expand_by_default=False):
            contacts = gui.add_checkbox("contact points", False)
            contacts.on_update(lambda _: setattr(self, "contacts", contacts.value))
            for name in session.ours.setup_manager_visualizers():
                self._add_drawing(name)

    def show(self, *, ignored: int = 0) -> None:
        """Bring the widgets up to date; viser sends those that changed. `ignored` messages were not let in."""
        session = self._session
        if session.playing:
            label = "Pause"
            icon = viser.Icon.PLAYER_PAUSE
        else:
            label = "Play"
            icon = viser.Icon.PLAYER_PLAY
        # Only where it changed, since each set is a message.
        if self._play.label != label:
            self._play.label = label
            self._play.icon = icon
        self._env.value = session.env_index
        self._show_motion()
        self._status.content = self._status_html(ignored)
        self._error.content = self._error_html()
        self._error.visible = bool(session.error)

    def drive(self, shares: Mapping[int, float]) -> None:
        """Set the fields of the first command to shares of their ranges: -1 is the low end, 0 rest, 1 the high end.

        Rest is 0 where the range holds it, else its middle. Where a person acts it is columns of the action instead.
        From any thread.
        """
        if self._action:
            for number, share in shares.items():
                if number < len(self._action):
                    slider = self._action[number]
                    slider.value = _at_share(share, float(slider.min), float(slider.max))
            self._session.ask(self._act)
            return
        # Only the first command: the loop returns in its first pass.
        for command, (by_hand, sliders) in self._steering.items():
            for number, share in shares.items():
                if number >= len(sliders):
                    continue
                slider = list(sliders.values())[number]
                slider.value = _at_share(share, float(slider.min), float(slider.max))
            # Otherwise the command would be drawn again over the hand's values.
            by_hand.value = True
            self._session.ask(partial(self._steer, command))
            return

    def _status_html(self, ignored: int) -> str:
        session = self._session
        ours = session.ours
        seconds = float(ours.episode_step_E[session.env_index]) * ours.step_dt
        state = "running" if session.playing else "paused"
        heading = f"<b>{as_html(session.title)}</b> {as_html(session.note)}"
        figures = (
            f"{state}, episode {seconds:.2f} s, return "
            f"{session.episode_return:.2f}, speed {session.achieved_speed:.2f}, step {session.steps}"
        )
        count = ignored + session.refused
        if count:
            figures += f", {count} messages ignored"
        return paragraph(heading) + paragraph(figures)

    def _error_html(self) -> str:
        told = as_html(f"{self._session.error}\n\n{self._session.trace}")
        listing = (
            f'<pre style="margin:0;padding:0 1em;overflow-x:auto;font-size:0.8em">{told}</pre>'
        )
        return paragraph("<b>Paused by an error</b>") + listing

    def _add_command(
        self, name: str, ranges: Mapping[str, tuple[float, float]], *, prefix: str
    ) -> None:
        gui = self._gui
        by_hand = gui.add_checkbox(f"{name} by hand", False)
        by_hand.on_update(lambda _: self._session.ask(partial(self._steer, name)))
        sliders = {}
        for field, (low, high) in ranges.items():
            # viser refuses a slider whose ends are equal.
            step = max((high - low) / 100, 1e-3)
            rest = _at_share(0.0, low, high)
            sliders[field] = gui.add_slider(prefix + field, low, max(high, low + step), step, rest)
            sliders[field].on_update(partial(self._moved, name))
        self._steering[name] = (by_hand, sliders)

    def _add_action(self, ranges: Mapping[str, tuple[float, float]]) -> None:
        for name, (low, high) in ranges.items():
            step = max((high - low) / 100, 1e-3)
            rest = _at_share(0.0, low, high)
            slider = self._gui.add_slider(name, low, max(high, low + step), step, rest)
            slider.on_update(self._acted)
            self._action.append(slider)

    def _acted(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # else moved by the program, which asks for itself
            self._session.ask(self._act)

    def _act(self) -> None:
        values = {column: float(slider.value) for column, slider in enumerate(self._action)}
        self._session.drive(values)

    def _moved(self, name: str, event: viser.GuiEvent) -> None:
        if event.client is None:  # moved by the program, which asks for itself
            return
        self._steering[name][0].value = True
        self._session.ask(partial(self._steer, name))

    def _steer(self, name: str) -> None:
        by_hand, sliders = self._steering[name]
        values = {field: float(slider.value) for field, slider in sliders.items()}
        # Without the tick the command is drawn again.
        self._session.steer(name, values if by_hand.value else None)

    def _add_scrubber(
        self, motion: ReferenceMotion
    ) -> tuple[viser.GuiDropdownHandle[str], viser.GuiSliderHandle[float]]:
        options = []
        for name, is_held_out in zip(motion.names, motion.held_out, strict=True):
            options.append(f"{name} (held out)" if is_held_out else name)
        clip = self._gui.add_dropdown("Clip", options)
        # Of the longest clip: in a shorter one the rest of the way is its end.
        step_s = self._session.ours.step_dt
        time = self._gui.add_slider("Time (s)", 0.0, max(motion.duration_s, step_s), step_s, 0.0)

        def seek(event: viser.GuiEvent, time_s: float) -> None:
            # Moved by the program, which shows where the env is.
            if event.client is None:
                return
            place = options.index(clip.value)
            self._session.ask(partial(self._session.seek, place, time_s))

        # Another clip begins at its start.
        clip.on_update(lambda event: seek(event, 0.0))
        time.on_update(lambda event: seek(event, float(time.value)))
        return clip, time

    def _show_motion(self) -> None:
        motion = self._session.motion
        if self._scrubber is None or motion is None:
            return
        clip, time = self._scrubber
        env_index = self._session.env_index
        clip.value = clip.options[motion.clip(env_index)]
        # On the slider's own marks, which lie a step apart.
        time.value = round(motion.time_s(env_index) / time.step) * time.step

    def _add_condition(self, name: str) -> None:
        widget = self._gui.add_checkbox(name, getattr(self._session.conditions, name))

        def change() -> None:
            self._session.change(
                dataclasses.replace(self._session.conditions, **{name: widget.value})
            )

        widget.on_update(lambda _: self._session.ask(change))

    def _add_drawing(self, name: str) -> None:
        self.drawn.add(name)
        widget = self._gui.add_checkbox(name, True)

        def change(_: viser.GuiEvent) -> None:
            if widget.value:
                self._session.ask(partial(self.drawn.add, name))
            else:
                self._session.ask(partial(self.drawn.discard, name))

        widget.on_update(change)


def _at_share(share: float, low: float, high: float) -> float:
    if low <= 0.0 <= high:
        rest = 0.0
    else:
        rest = (low + high) / 2
    # Each side of rest has its own scale, as ranges need not be symmetric.
    return rest + share * (high - rest if share > 0 else rest - low)


def _value(event: viser.GuiEvent) -> object:
    return event.target.value
