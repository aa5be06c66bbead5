"""What pictures, their gradients and the removal of splats cost."""
