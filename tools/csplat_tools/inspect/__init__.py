"""What is in a file, whether it is valid, whether its stated errors hold, and how it differs from its source."""
