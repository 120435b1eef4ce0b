"""This room keeps trained policies that come with the package, and fetches those that lie elsewhere."""

from ksim_rl.zoo.cards import Card, cards, read_card
from ksim_rl.zoo.sources import locate
