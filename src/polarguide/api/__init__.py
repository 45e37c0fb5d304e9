"""Python interface that ``import polarguide`` provides: functions on captures and on runs."""
