"""Pictures of scenes and of what was learned (PNG)."""
