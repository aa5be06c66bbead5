"""What training takes: a step of it, stage by stage; Lego by number of splats."""
