"""The benchmark sets that papers report: trained, scored, encoded, scored again."""
