"""What targets give, beside presets, fixed shares of the splats, and another build."""
