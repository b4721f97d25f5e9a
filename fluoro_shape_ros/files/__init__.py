"""Files and bags: replay and its report, import, DICOM, calibration."""
