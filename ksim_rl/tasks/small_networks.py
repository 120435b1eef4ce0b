"""What training settings of tasks with one or two joints share."""

SMALL_NETWORKS = {
    "modules.actor.hidden_dims": [64, 64],
    "modules.critic.hidden_dims": [64, 64],
    # Values reach 100 here: clipping their change to 0.2 would stop the critic from learning.
    "objective.clip_value": False,
    "objective.schedule": "fixed",
}
