"""The published methods, FluidNexus and WildSmoke, from one view: their formulas, in this project's fluid and renderer."""
