"""What a safety team tries first: kills, signals, and what comes out afterwards."""
