"""Focus report: one page that shows what moving the sensor did."""
