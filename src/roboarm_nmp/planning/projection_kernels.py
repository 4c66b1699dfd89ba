"""The compiled projection of actions onto constraints of link distances."""

import numpy as np

from roboarm_nmp.utils.numba_cache import compiled


@compiled
def project(
    actions,
    link_distances,
    margins,
    rates,
    max_step,
    cbf_gain,
    activation_distance,
    max_recovery,
    projection_sweeps,
):
    """Change actions (m, n) in place: `policies.safety_filter.SafetyFilter.__call__`.

    Each sweep projects an action onto one link's half-space after the other.
    `link_distances`: (m, l, 1 + n); `margins`: m, (m, l); `rates`: m per step, (m, l).
    """
    for i in range(actions.shape[0]):
        action = actions[i]
        _shorten(action, max_step)
        for _ in range(projection_sweeps):
            for link in range(link_distances.shape[1]):
                row = link_distances[i, link]
                if row[0] >= activation_distance:
                    continue
                squared = along = 0.0
                for j in range(action.shape[0]):
                    squared += row[1 + j] * row[1 + j]
                    along += row[1 + j] * action[j]
                short = min(cbf_gain * (margins[i, link] - row[0]), max_recovery)
                short = short - rates[i, link] - along
                if short > 0.0 and squared > 1e-12:
                    for j in range(action.shape[0]):
                        action[j] += row[1 + j] * short / squared
        _shorten(action, max_step)


@compiled
def _shorten(action, max_step):
    """Scale an action to a norm of at most `max_step`, in place."""
    squared = 0.0
    for j in range(action.shape[0]):
        squared += action[j] * action[j]
    if squared > max_step * max_step:
        for j in range(action.shape[0]):
            action[j] *= max_step / np.sqrt(squared)
