"""Pictures finer than the pixels of the sensor."""
