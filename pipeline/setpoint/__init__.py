"""Loop 3: the nozzle image sets flow and temperature (Li and Pattinson 2025)."""
