"""Trained policies that come with the package, and those that are fetched from elsewhere."""

from ksim_rl.zoo.cards import Card, cards, read_card
from ksim_rl.zoo.sources import locate
