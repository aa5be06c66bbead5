"""A published study of simple strategies, done again."""
