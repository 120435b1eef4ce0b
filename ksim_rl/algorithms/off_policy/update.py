"""An off-policy iteration puts a rollout into the replay and makes gradient steps; it is one CUDA graph on CUDA."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Int64, Num
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from ksim_rl.algorithms.gradient_steps import (
    RolloutUpdate,
    in_columns,
    load_optimizer_state,
    optimizer_state,
)
from ksim_rl.data import MASK_KEY, OfflineTable, ReplayCfg, ReplayRing, offline_keys
from ksim_rl.device import state_tree
from ksim_rl.device.capture import Captured
from ksim_rl.device.compiling import compiled
from ksim_rl.device.state_tree import State, branch
from ksim_rl.modules import ExploringPolicy, picture_encoders, update_normalizers
from ksim_rl.objectives import (
    FlatAdamW,
    OffPolicyCfg,
    OffPolicyLoss,
    SACCfg,
    SACLoss,
    ShiftedPictures,
    SymmetricAugmentation,
    frozen,
    go_back,
)
from ksim_rl.transforms import MirrorMap
from ksim_rl.transforms.specs import spell

# Names of the logged means, by the names that the losses give them.
LOGGED = {
    "loss_qvalue": "loss/value",
    "value": "update/q_value",
    "td_error": "update/td_error",
    "critic_grad_norm": "update/critic_grad_norm",
    "loss_actor": "loss/policy",
    "actor_grad_norm": "update/actor_grad_norm",
}
OF_TEMPERATURE = {"entropy": "loss/entropy", "alpha": "update/alpha"}


class OffPolicyUpdate(RolloutUpdate):
    """Adds a rollout to the replay and improves actor and critics with minibatches of it, without a host sync.

    Until each env has made `learning_starts` steps, rollouts have random actions, or actions of the policy whose
    weights were loaded, and there are no gradient steps. Until `policy_starts` the critics learn alone. From then on an
    update is `num_minibatches` gradient steps of the critics, each followed by one of the target networks, and by one
    of the actor (and the temperature) every `policy_delay`, which divides that number. For `cfg.symmetry`, `mirror` has
    mirror images of the networks' inputs and of the action. Of observations whose frames' ages are in `stacks` (see
    `stacked_frames`), the replay holds each frame once. `shared`: `RolloutUpdate`'s other arguments.
    """

    def __init__(
        self,
        cfg: OffPolicyCfg,
        *,
        loss: OffPolicyLoss,
        behavior: ExploringPolicy,
        data: ReplayCfg,
        num_envs: int,
        mirror: Mapping[NestedKey, MirrorMap] | None = None,
        stacks: Mapping[NestedKey, Sequence[int]] | None = None,
        **shared: Any,
    ) -> None:
        if data.num_minibatches % cfg.policy_delay:
            raise ValueError(
                f"data.num_minibatches={data.num_minibatches} is no multiple of objective.policy_delay="
                f"{cfg.policy_delay}: each iteration makes the same gradient steps"
            )
        networks = {
            "actor": loss.actor_network,
            "critic": loss.critic_network,
            "target_critic": loss.target_critic_network,
        }
        logged = LOGGED | (OF_TEMPERATURE if isinstance(loss, SACLoss) else {})
        super().__init__(networks, max_skipped_steps=cfg.max_skipped_steps, logged=logged, **shared)
        self.cfg = cfg
        self.loss = loss
        self.data = data
        self.actor: TensorDictModuleBase = loss.actor_network
        self.critic = loss.critic_network
        self.behavior = behavior
        self.num_env_states = num_envs * data.num_steps
        self._observations: list[NestedKey] = loss.observation_keys
        # Each part by itself: backward passes and optimizer steps lie between them.
        fast: Any = partial(compiled, device=self.device, wanted=cfg.compile)
        self._images = None
        if cfg.symmetry == "augment":
            self._images = SymmetricAugmentation(
                mirror, read=self._observations, device=self.device
            )
        self._shifted = None
        if cfg.random_shift:
            encoders = picture_encoders(self.actor, self.critic)
            self._shifted = ShiftedPictures(
                {key: encoder.layout for key, encoder in encoders.items()},
                pixels=cfg.random_shift,
                minibatch=data.num_env_states_per_minibatch,
            )
            # Before anything is collected.
            for key, encoder in encoders.items():
                self._shifted.check_shape(key, encoder.shape)
        self._read = fast(self._stored)
        self._count_ = fast(self._counted_)
        self._critic_loss = fast(loss.critic_loss)
        self._actor_losses = fast(loss.actor_losses)
        self.replay = ReplayRing(
            data,
            num_envs=num_envs,
            observations=self._observations,
            gamma=cfg.gamma,
            stacks={key: ages for key, ages in (stacks or {}).items() if key in self._observations},
            device=self.device,
        )
        # The optimizer of the critics moves the targets in the same step.
        target = loss.target_critic_network.parameters()
        rate = cfg.critic_learning_rate
        self.optimizers = {
            "critic": FlatAdamW(cfg, self.critic.parameters(), learning_rate=rate, target=target),
            "actor": FlatAdamW(cfg, self.actor.parameters(), learning_rate=cfg.actor_learning_rate),
        }
        if isinstance(cfg, SACCfg) and isinstance(loss, SACLoss) and loss.log_alpha.requires_grad:
            # A temperature that decays towards alpha = 1 would not be the one that the entropy asks for.
            free = replace(cfg, weight_decay=0.0)
            rate = cfg.alpha_learning_rate
            self.optimizers["alpha"] = FlatAdamW(free, [loss.log_alpha], learning_rate=rate)
        self.steps_made = 0
        self.notes: list[str] = []  # said at the start of a run
        # Zero until learning starts.
        for name in logged.values():
            self._means[name] = torch.zeros((), device=self.device)
        # Graphs of their own: for rollouts that are only stored, and for those that only the critics learn from.
        self._store_only = Captured(self._store, device=self.device)
        self._critics_only = Captured(self._improve_critics, device=self.device)
        if data.policy_starts:
            self._work.insert(0, self._critics_only)
        self._work.insert(0, self._store_only)

    def learn_also_from(self, table: OfflineTable) -> None:
        """Let minibatches have `data.offline.share` of recorded env states, which count once for normalizers."""
        self.replay.offline = table
        storage = table.storage
        assert storage.content is not None
        recorded_N = storage.content.select(*self._observations)[storage.available]
        update_normalizers(recorded_N, self.actor, self.critic)

    @property
    def rollout_keys(self) -> list[NestedKey]:
        """The leaves of an env state that an update reads."""
        following = [unravel_key(("next", key)) for key in self._observations]
        return [*self._observations, "action", *following, *self.signals.following]

    @property
    def _kept_keys(self) -> list[NestedKey]:
        """The leaves that the replay keeps, where reward and flags have the names that TorchRL gives them."""
        return offline_keys(self._observations)

    def __call__(self, rollout_ET: TensorDictBase) -> None:
        """Learn from a rollout `["E","T"]`, or only keep it while the actions are random."""
        self._rollout_ET = rollout_ET
        self.steps_made += self.data.num_steps
        # Counted on the host, which knows it without asking the device.
        learns = self.steps_made >= self.data.learning_starts
        if not learns:
            work = self._store_only
        elif self.steps_made < self.data.policy_starts:
            work = self._critics_only
        else:
            work = self._run
        with self._watched.watched():
            work()
        if learns:
            self.behavior.random.fill_(False)

    def restarted(self) -> None:
        """Let no env state of before the next rollout go on in it."""
        self.replay.cut()

    def metrics(self) -> dict[str, Num[Tensor, ""]]:
        """Return the measurements of the last update; see `RolloutUpdate`."""
        return super().metrics() | {
            "replay/env_states": self.replay.num_stored,
            "replay/inexact_env_states": self.replay.inexact_count,
            "update/non_finite_env_states": self.replay.non_finite_count,
        }

    def _store(self) -> None:
        rollout_ET = self.rollout_ET
        # A recorder of the run may read more: the ring would keep it for each of its env states.
        self.replay.extend(rollout_ET.select(*self._kept_keys))
        # Unlike on policy, gradient steps need not see the statistics that the actions were drawn with.
        update_normalizers(rollout_ET, self.actor, self.critic)
        # An env that ended an episode anywhere in the rollout explores with another scale of noise from now on.
        self.behavior.end_episodes_(rollout_ET.get(("next", "done")).squeeze(-1).any(1))

    def _improve_critics(self) -> None:
        """Store a rollout, and let the critics learn while the policy stays as it is."""
        self._store()
        steps = []
        for minibatch_B in self._minibatches():
            steps.append(self._improve_critic(minibatch_B))
        columns = in_columns(steps)
        longest = self._count_(columns["skipped"])
        self._measure_(columns | {"skipped_in_a_row": longest.expand_as(columns["skipped"])})

    def _minibatches(self) -> Iterator[TensorDictBase]:
        return self.replay.minibatches(self.data.num_minibatches, read=self._read)

    def _update(self) -> None:
        self._store()
        of_critic = []
        of_actor = []
        # The actor learns on every `policy_delay`-th minibatch, after the critics have.
        for step, minibatch_B in enumerate(self._minibatches(), start=1):
            of_critic.append(self._improve_critic(minibatch_B))
            if step % self.cfg.policy_delay == 0:
                of_actor.append(self._improve_actor(minibatch_B))
        columns = in_columns(of_critic), in_columns(of_actor)
        # Counted once for all steps, since each is skipped if either of its parts was.
        longest = self._count_(*(own["skipped"] for own in columns))
        self._measure_(columns[0] | {"skipped_in_a_row": longest.expand_as(columns[0]["skipped"])})
        self._means.take_(columns[1])

    def _counted_(self, of_critic_S: Tensor, of_actor: Tensor | None = None) -> Tensor:
        """Count S gradient steps, skipped if one of their parts was; return how many in a row were at most."""
        longest = torch.zeros_like(self.guard.skipped)
        delay = self.cfg.policy_delay
        for step, skipped in enumerate(of_critic_S.unbind(), start=1):
            if of_actor is not None and step % delay == 0:
                skipped = torch.maximum(skipped, of_actor[step // delay - 1])
            self.guard.count_(skipped)
            longest = torch.maximum(longest, self.guard.skipped_in_a_row)
        return longest

    def _stored(self, *index: Int64[Tensor, " ?N"]) -> TensorDictBase:
        """Return env states of the replay for their indices, as `cfg.symmetry` and `cfg.random_shift` change them."""
        env_states_B = self.replay.env_states(*index)
        if self._images is not None:
            self._images.reflect_every_second_(env_states_B)
        if self._shifted is not None:
            self._shifted.shift_(env_states_B)
        return env_states_B

    def _improve_critic(self, minibatch_B: TensorDictBase) -> dict[str, Tensor]:
        """Make one gradient step of critics and targets; return its measurements, and `skipped`, 0 or 1."""
        with self._precision():
            loss, logged = self._critic_loss(minibatch_B)
        norm, skipped = self._descend({"critic": loss}, minibatch_B)["critic"]
        # The loss has left the error of each env state in the minibatch.
        if self.data.prioritized:
            self.replay.update_priority(minibatch_B.get("index"), minibatch_B.get("td_error"))
        return logged | {"loss_qvalue": loss, "critic_grad_norm": norm, "skipped": skipped}

    def _improve_actor(self, minibatch_B: TensorDictBase) -> dict[str, Tensor]:
        """Make one gradient step of the actor and the temperature; return the same as `_improve_critic`."""
        # Frozen here as well, where the compiler does not follow.
        with self._precision(), frozen(self.critic):
            losses, logged = self._actor_losses(minibatch_B)
        learning = [name for name in ("actor", "alpha") if name in self.optimizers]
        losses_of = {name: losses[f"loss_{name}"] for name in learning}
        steps = self._descend(losses_of, minibatch_B)
        norm, skipped = steps["actor"]
        # A step counts as skipped if the temperature's was.
        if "alpha" in steps:
            skipped = torch.maximum(skipped, steps["alpha"][1])
        return logged | {
            "loss_actor": losses["loss_actor"],
            "actor_grad_norm": norm,
            "skipped": skipped,
        }

    def _descend(
        self, losses: dict[str, Tensor], minibatch_B: TensorDictBase
    ) -> dict[str, tuple[Tensor, Tensor]]:
        go_back(losses, self.optimizers, mask=minibatch_B.get(MASK_KEY))
        return {name: self.optimizers[name].step(loss) for name, loss in losses.items()}

    def _precision(self) -> torch.autocast | nullcontext[None]:
        # The cache of casted weights would outlive the steps that change them in a captured graph.
        return torch.autocast(
            self.device.type, torch.bfloat16, enabled=self.cfg.autocast, cache_enabled=False
        )

    def state_dict(self) -> state_tree.State:
        """Return networks, optimizers, replay, exploration and counters."""
        state = {
            **super().state_dict(),
            "optimizers": {name: optimizer_state(own) for name, own in self.optimizers.items()},
            "replay": self.replay.state_dict(),
            "exploration": self.behavior.exploration_state(),
            "steps_made": self.steps_made,
        }
        if isinstance(self.loss, SACLoss):
            state["log_alpha"] = self.loss.log_alpha
        return state

    def load_state_dict(self, state: State) -> None:
        """Continue where `state_dict` was taken; where it has no replay, with random actions until there is one."""
        super().load_state_dict(state)
        for name, optimizer in self.optimizers.items():
            saved = branch(branch(state, "optimizers"), name)
            load_optimizer_state(optimizer, saved, what=f"{name} optimizer")
        exploration = branch(state, "exploration")
        state_tree.copy_into(self.behavior.exploration_state(), exploration, what="exploration")
        replay = self._of_own_leaves(branch(state, "replay"))
        self.replay.load_state_dict(replay)
        # Without a replay the run has to collect random actions first, as at its start.
        if "ring" in replay:
            self.steps_made = int(state_tree.number(state, "steps_made"))
        else:
            self.steps_made = 0
            self.behavior.random.fill_(True)
        if self.steps_made >= self.data.learning_starts:
            self.behavior.random.fill_(False)

    def _of_own_leaves(self, replay: State) -> State:
        """Return the state of a replay without leaves that this run does not read, which replays of before held."""
        if "ring" not in replay:
            return replay
        read = {spell(key) for key in self._kept_keys}
        ring = branch(replay, "ring")
        content = branch(ring, "content")
        own = {name: content[name] for name in content if name in read}
        return {**replay, "ring": {**ring, "content": own}}

    def load_weights(self, state: State) -> None:
        """Take networks and temperature of a `state_dict`; a ValueError names a tensor or action bound that differs.

        The loaded policy also makes the first rollouts, before learning starts: random ones would tell the critics
        nothing about it (WSRL, Zhou et al., arXiv 2412.07762).
        """
        # Before any weight is copied.
        self._check_action_bounds(branch(state, "actor"))
        super().load_weights(state)
        if isinstance(self.loss, SACLoss):
            with torch.no_grad():
                self.loss.log_alpha.copy_(state_tree.tensor(state, "log_alpha"))
        self.behavior.random.fill_(False)

    def _check_action_bounds(self, saved: State) -> None:
        """Refuse an actor that was trained for other actions: its bounds are not weights, and come from the config."""
        for name, bound in self.actor.state_dict().items():
            if name not in saved or not name.endswith((".low", ".high")):
                continue
            own = bound.cpu()
            theirs = state_tree.tensor(saved, name).cpu()
            if not torch.equal(theirs, own):
                raise ValueError(
                    f"modules.actor.action_bound: {name!r} is {own.tolist()} in this run and {theirs.tolist()} in the "
                    "checkpoint; take the bound of the checkpoint's run"
                )
