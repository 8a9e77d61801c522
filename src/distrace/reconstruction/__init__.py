"""Shape and colours of an object that no class knows: a network of its own, learnt from photographs."""
