"""PTB's Digital Calibration Certificate: elements, quantities in D-SI, administrative data, results."""

from mwdcal.certificate.dcc.writer import to_xml

__all__ = ["to_xml"]
