"""What a critic says of a batch: values of its rows, of terminal observations, of the row after the last.

With a memory the rounds are gone through one by one, and each slot's state is kept for the next batch; so are
traces of what it observed, and for a critic that reads actions the one that is under way.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor

from mappo_unity import keys
from mappo_unity.learning.carried import VALUED
from mappo_unity.learning.networks.poca import PocaCritic
from mappo_unity.learning.networks.recurrent import BASELINE_STATE, VALUE_STATE, RecurrentCritic
from mappo_unity.learning.networks.traces import ObservationTraces
from mappo_unity.learning.value_norm import ValueNorm


@dataclass
class Values:
    """Values in the reward's scale, of V reward streams; R = carried rounds + rounds of the batch."""

    value: Tensor  # [R, ..., A, V]
    end: Tensor  # [R, ..., A, V]: of terminal observations, where an episode was cut off; 0 elsewhere
    final: Tensor  # [..., A, V]: of the row after the last
    baseline: Tensor | None = None  # [R, ..., A, V], of a POCA critic
    states: dict[str, Tensor] = field(default_factory=dict)  # [R, ..., A, M], before each row


class ValueReader:
    """Ask a critic about batches.

    Args:
        critic: see `learning.networks.actor_critic.make_critic`.
        norm: turns its output into the reward's scale.

    Attributes: `has_baseline`, whether it is MA-POCA's, which reads actions.
    """

    def __init__(self, critic: TensorDictModule, norm: ValueNorm) -> None:
        self.critic, self.norm = critic.module, norm
        self.keys = [str(key) for key in critic.in_keys]
        self.traces = next((m for m in critic.modules() if isinstance(m, ObservationTraces)), None)
        self.has_baseline = any(isinstance(m, PocaCritic) for m in critic.modules())
        self.states: dict[str, Tensor] = {}  # [..., A, M], before the next batch's first row
        self._before: dict[str, Tensor] = {}  # those before the batch that was read last

    @torch.no_grad()
    def traced(
        self, batch: TensorDictBase, following: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """Return a batch and what followed it with `keys.TRACES`, where the critic reads them.

        Args:
            batch: ``[T, ..., A]``, as collected.
            following: what was seen after it, see `keys.FINAL`, `keys.CUT_OFF` and `keys.CUT_OFF_AT`.
        """
        net = self.traces
        if net is None:
            return batch, following

        def walk(state: Tensor, rows: TensorDictBase) -> Tensor:
            return net.walk(state, *(rows.get(key) for key in (keys.OBS, keys.FIRST, keys.ACTING)))

        rows = walk(self._state(keys.TRACES, batch.get(keys.OBS)[0], net.size), batch)
        self.states[keys.TRACES] = rows[-1]

        final, cut_off = following.get(keys.FINAL), following.get(keys.CUT_OFF)
        # a terminal observation follows the slot's last decision
        ended = net.after(rows.flatten(0, -3)[following.get(keys.CUT_OFF_AT)], cut_off.get(keys.OBS))
        after = {
            keys.FINAL: final.copy().set(keys.TRACES, walk(rows[-1], final.unsqueeze(0))[0]),
            keys.CUT_OFF: cut_off.copy().set(keys.TRACES, ended),
        }
        return batch.copy().set(keys.TRACES, rows), following.copy().update(after)

    @torch.no_grad()
    def with_actions_under_way(self, batch: TensorDictBase) -> TensorDictBase:
        """Return a batch in which members that were not asked show what they are doing, for a POCA critic.

        What the policy drew for such a member in this round is not played: it goes on with the action that
        it chose when it was asked last.

        Args:
            batch: ``[T, ..., A]``, as collected.
        """
        if not self.has_baseline:
            return batch

        acting, drawn = batch.get(keys.ACTING), batch.get(keys.ACTION)
        waits = batch.get(keys.PRESENT) & ~batch.get(keys.DEPARTED) & ~acting
        if not bool(waits.any()):  # whoever comes later is asked first
            self.states[keys.ACTION] = drawn[-1]
            return batch

        under_way, rows = self._state(keys.ACTION, drawn[0], drawn.shape[-1]), []
        for asked, waiting, action in zip(acting, waits, drawn, strict=True):
            under_way = torch.where(asked, action, under_way)
            rows.append(torch.where(waiting, under_way, action))

        self.states[keys.ACTION] = under_way
        return batch.copy().set(keys.ACTION, torch.stack(rows))

    @torch.no_grad()
    def read(self, rounds: TensorDict, following: TensorDictBase) -> Values:
        """Return the values of a batch.

        Args:
            rounds: ``[R, ..., A]``, as `CarriedRounds.join` returns them.
            following: what was seen after them, see `keys.FINAL`, `keys.CUT_OFF` and `keys.CUT_OFF_AT`.
        """
        self._before = dict(self.states)
        if isinstance(self.critic, RecurrentCritic):
            return self._read_in_turn(self.critic, rounds, following)

        inputs = self._inputs(rounds)
        value, baseline = self._value_and_baseline(inputs, rounds)
        end = torch.zeros_like(value)
        at, cut_off = following.get(keys.CUT_OFF_AT), following.get(keys.CUT_OFF)
        if len(at):
            end.flatten(0, -3)[at] = self._value(self._inputs(cut_off))

        return Values(value, end, self._value(self._inputs(following.get(keys.FINAL))), baseline)

    def read_again(self, rounds: TensorDict, following: TensorDictBase) -> Values:
        """Return the values of the batch that was read last, by the critic as it is now; states stay."""
        after, self.states = self.states, self._before
        values = self.read(rounds, following)
        self.states = after
        return values

    @torch.no_grad()
    def values_of(self, entries: TensorDictBase) -> Tensor:
        """Return the values of single observations, by a critic without a memory, in the reward's scale."""
        return self._value(self._inputs(entries))

    def keep(self, values: Values, pending: Tensor) -> None:
        """Keep the states for the next batch; slots with a pending decision go back to before it.

        Args:
            values: what `read` returned.
            pending: bool ``[R, ..., A, 1]``; a pending row is the last one with a value of its slot.
        """
        for name, states in values.states.items():
            before = torch.where(pending, states, 0.0).sum(0)
            self.states[name] = torch.where(pending.any(0), before, self.states[name])

    def _inputs(self, entries: TensorDictBase) -> list[Tensor]:
        return [entries.get(key) for key in self.keys]

    def _value(self, inputs: list[Tensor]) -> Tensor:
        return self.norm.denormalize(self.critic(*inputs))

    def _value_and_baseline(
        self, inputs: list[Tensor], rounds: TensorDictBase
    ) -> tuple[Tensor, Tensor | None]:
        if not isinstance(self.critic, PocaCritic):
            return self._value(inputs), None
        value, baseline = self.critic.value_and_baseline(*inputs, rounds.get(keys.ACTION))
        return self.norm.denormalize(value), self.norm.denormalize(baseline)

    def _read_in_turn(self, critic: RecurrentCritic, rounds: TensorDict, following: TensorDictBase) -> Values:
        inputs = self._inputs(rounds)
        action = rounds.get(keys.ACTION) if critic.has_baseline else None
        first, valued = rounds.get(keys.FIRST), rounds.get(VALUED)

        outputs, states, after = {}, {}, {}
        for name, features in critic.features(inputs, action).items():
            outputs[name], states[name], after[name] = self._walk(critic, name, features, first, valued)

        value = self.norm.denormalize(critic.values(outputs[VALUE_STATE]))
        end = torch.zeros_like(value)
        at, cut_off = following.get(keys.CUT_OFF_AT), following.get(keys.CUT_OFF)
        if len(at):
            # a terminal observation follows the slot's last decision
            features = critic.features(self._inputs(cut_off))[VALUE_STATE]
            out, _ = critic.step(features, after[VALUE_STATE].flatten(0, -3)[at])
            end.flatten(0, -3)[at] = self.norm.denormalize(critic.values(out))

        features = critic.features(self._inputs(following.get(keys.FINAL)))[VALUE_STATE]
        final = self.norm.denormalize(critic.values(critic.step(features, after[VALUE_STATE][-1])[0]))

        baseline = outputs.get(BASELINE_STATE)
        if baseline is not None:
            baseline = self.norm.denormalize(critic.values(baseline))
        return Values(value, end, final, baseline, states)

    def _walk(
        self, critic: RecurrentCritic, name: str, features: Tensor, first: Tensor, valued: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return outputs, states before and states after each row; the last of these is kept."""
        state = self._state(name, features[0], critic.memory.state_size)
        outputs, before, after = [], [], []
        for row in range(len(features)):
            state = torch.where(first[row], 0.0, state)
            before.append(state)
            out, new = critic.step(features[row], state)
            outputs.append(out)
            state = torch.where(valued[row], new, state)
            after.append(state)

        self.states[name] = state
        return torch.stack(outputs), torch.stack(before), torch.stack(after)

    def _state(self, name: str, row: Tensor, size: int) -> Tensor:
        """Return the state ``[..., A, size]`` before the batch whose first row is given, ``[..., A, *]``."""
        state = self.states.get(name)
        if state is None or state.shape[:-1] != row.shape[:-1]:
            return row.new_zeros(*row.shape[:-1], size)
        return state

    def state_dict(self) -> dict[str, Tensor]:
        """Return what resuming needs."""
        return {name: state.clone() for name, state in self.states.items()}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what `state_dict` returned, on the critic's device."""
        device = next(self.critic.parameters()).device
        self.states = {name: values.to(device) for name, values in state.items()}
