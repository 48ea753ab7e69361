"""Files of other programs: calibrations, landmarks, videos."""
