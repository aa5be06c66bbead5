"""What pictures, their gradients, the removal of splats and the first call of anything cost."""
