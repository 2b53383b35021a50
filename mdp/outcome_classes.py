"""The outcomes of a transition model as somebody sees them who watches: equal ones are one.

Rows are numbered ``state * A + action``. Rewards are told apart in single precision, in which
agents are given them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mdp.array_types import Floats, Ints
from mdp.transition_model import TransitionModel

Observed = tuple[int, int, float, bool]
"""Row, next state, reward in single precision, and whether the episode terminated."""

# Probabilities within this of one are one, and rows this alike are the same.
TOLERANCE = 1e-9
MAX_TABLE = 4_000_000


class OutcomeClasses:
    """Classes of outcomes that cannot be told apart.

    Args:
        model: the transition model.

    Attributes:
        ids: the class of everything that may be observed; classes of a row follow each other, in
            the model's order.
        row: the row of each class, shape (C,).
        place: which of its row's classes it is, from 0 on, shape (C,).
        row_prob: probabilities of a row's classes, padded with zeros, shape (S * A, M).
        pattern: rows with the same probabilities have the same pattern, shape (S * A,).
        pattern_prob: the probabilities of each pattern, shape (P, M).
    """

    def __init__(self, model: TransitionModel) -> None:
        self._model = model
        n_rows = model.n_states * model.n_actions
        prob = model.prob.reshape(n_rows, -1)
        possible = prob > 0
        rows, _ = np.nonzero(possible)
        with np.errstate(over="ignore"):
            reward = model.reward.astype(np.float32)
        arrays: tuple[Any, ...] = (model.next_state, reward, model.terminated)
        seen = (array.reshape(n_rows, -1)[possible].tolist() for array in arrays)
        self.ids: dict[Observed, int] = {}
        classes = [
            self.ids.setdefault(key, len(self.ids))
            for key in zip(rows.tolist(), *seen, strict=True)
        ]
        self._of_outcome = np.full(prob.shape, -1)
        self._of_outcome[possible] = classes
        self.row: Ints = np.array([key[0] for key in self.ids])
        self.place: Ints = np.arange(len(self.row)) - np.searchsorted(self.row, self.row)
        self.row_prob = np.zeros((n_rows, int(self.place.max()) + 1))
        self.row_prob[self.row, self.place] = np.bincount(classes, prob[possible])
        self.row_prob[self.row_prob > 1 - TOLERANCE] = 1
        rounded = (self.row_prob / TOLERANCE).round()
        _, first, pattern = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
        self.pattern: Ints = pattern.reshape(-1)
        self.pattern_prob: Floats = self.row_prob[first]

    def prob_of(self, observed: Observed) -> float:
        """The probability that the model gives to what was observed."""
        found = self.ids.get(observed)
        return 0.0 if found is None else float(self.row_prob[observed[0], self.place[found]])

    def predicted(self, rows: Ints, uniforms: Floats) -> tuple[Ints, Floats]:
        """What `categorical_sample` of Gymnasium's toy_text makes of uniform numbers.

        Args:
            rows: where they are drawn, shape (n,).
            uniforms: the numbers, shape (n,).

        Returns:
            Classes, shape (n,), -1 where an outcome without probability is drawn; and rewards in
            full precision, likewise.
        """
        n_rows, n_outcomes = self._of_outcome.shape
        cumulative = np.cumsum(self._model.prob, axis=2).reshape(n_rows, -1)
        chosen = np.zeros(len(rows), np.int64)
        for start in range(0, len(rows), max(MAX_TABLE // n_outcomes, 1)):
            part = slice(start, start + max(MAX_TABLE // n_outcomes, 1))
            chosen[part] = np.argmax(cumulative[rows[part]] > uniforms[part, None], axis=1)
        reward = self._model.reward.reshape(n_rows, -1)
        return self._of_outcome[rows, chosen], reward[rows, chosen]
