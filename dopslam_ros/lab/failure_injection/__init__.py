"""Failures injected into runs: how soon and how well a vehicle that gets lost is found again."""
