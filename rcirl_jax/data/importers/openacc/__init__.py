"""OpenACC platoon recordings (CSV): `reader`."""
