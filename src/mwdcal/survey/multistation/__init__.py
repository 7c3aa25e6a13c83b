"""Multi-station analysis: interference of the drill string from the surveys themselves."""
