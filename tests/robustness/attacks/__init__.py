"""Attacks: hostile inputs by the thousand, each made of a seed and a number that repeat it."""
