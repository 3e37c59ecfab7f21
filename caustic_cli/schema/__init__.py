"""The schema of all settings: every section and setting once, and the checks of their values.  It stands below every other room."""
