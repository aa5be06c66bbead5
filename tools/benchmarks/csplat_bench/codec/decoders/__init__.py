"""Decoders of ours and of others: how fast they are, and whether ours agree bit by bit (`agree`)."""
