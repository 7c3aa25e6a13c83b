"""The schema of PTB's digital calibration certificates, and two programs that read them, without network."""

import importlib
import importlib.util
import locale
import os
import sys
import types
import warnings
from pathlib import Path

import pytest

VERSION = "3.3.0"
FOLDER = Path(os.environ.get("MWDCAL_DATA", "")) / "dcc"
NAMESPACES = {"dcc": "https://ptb.de/dcc", "si": "https://ptb.de/si"}
FILES = {
    "https://ptb.de/si/v2.2.1/SI_Format.xsd": "SI_Format-2.2.0.xsd",
    "https://www.ptb.de/si/v2.2.0/qudt/quantitykind.xsd": "quantitykind.xsd",
    "https://www.ptb.de/dcc/d-sig/xmldsig-core-schema.xsd": "xmldsig-core-schema.xsd",
}
"""Where the schemas import from, and the files that stand for it."""

KINDS = """<xs:schema xmlns:xs="http://www.w3.org/2001/XMLSchema" targetNamespace="http://qudt.org/vocab/">
<xs:simpleType name="quantitykind"><xs:restriction base="xs:string"/></xs:simpleType></xs:schema>"""
"""The vocabulary of kinds of quantities, which our certificates do not use, as any text."""

with_schema = pytest.mark.skipif(
    not (os.environ.get("MWDCAL_DATA") and FOLDER.is_dir()),
    reason="PTB's schemas: set MWDCAL_DATA to the folder that has them in 'dcc'",
)


def schema_folder(folder):
    """A folder with `dcc.xsd` and what it imports, all of it local."""
    xmlschema = pytest.importorskip("xmlschema")
    signatures = Path(xmlschema.__file__).parent / "schemas" / "DSIG"
    (folder / "quantitykind.xsd").write_text(KINDS, "utf-8")
    sources = [FOLDER / f"dcc-{VERSION}.xsd", FOLDER / "SI_Format-2.2.0.xsd"]
    for source in [*sources, signatures / "xmldsig-core-schema.xsd"]:
        text = source.read_text("utf-8")
        for address, local in FILES.items():
            text = text.replace(f'"{address}"', f'"{local}"')
        target = "dcc.xsd" if source == sources[0] else source.name
        (folder / target).write_text(text, "utf-8")
    return folder


def schema(folder):
    return pytest.importorskip("xmlschema").XMLSchema(str(folder / "dcc.xsd"), allow="local")


def pydcc_results(xml):
    """Name and `si:real` of every calibration result, by pydcc (Siemens)."""
    if importlib.util.find_spec("dcc") is None:
        pytest.skip("needs pydcc")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            module = importlib.import_module("dcc.dcc")
        except (
            Exception
        ):  # its check of X.509 signatures fails with OpenSSL 3.0.10 and newer: none here
            names = ("CertificateValidator", "errors", "ValidationContext")
            sys.modules["certvalidator"] = _module("certvalidator", dict.fromkeys(names))
            module = importlib.import_module("dcc.dcc")
    module.DCCXMLValidator = object  # it would download schemas
    client = module.DCC(byte_array=xml)
    return client, [
        (name, content["real"]) for name, content in client.get_calibration_results("name", "en")
    ]


class _Number:
    """A value and its standard uncertainty."""

    def __init__(self, value, stdunc=0.0):
        self.value, self.stdunc = float(value), float(stdunc)


def quantities(path, schemas):
    """Every `dcc:quantity` of the results in a file, by dccQuantities (PTB)."""
    if importlib.util.find_spec("dcc_quantities") is None:
        pytest.skip("needs dccQuantities")
    _stand_in_for_dotnet()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(locale, "getlocale", lambda: ("en_GB", "UTF-8"))  # it fails in the locale C
        manager = importlib.import_module("dcc_json_toolkit.cache").CacheManager
        patch.setattr(manager, "cache_xsd_file", lambda *_, **__: str(schemas / "dcc.xsd"))
        reader = importlib.import_module("dcc_quantities").DccQuantityType
        toolkit = importlib.import_module("dcc_json_toolkit")
        certificate = toolkit.DccSchema(VERSION).to_dict(str(path))
    return reader.extract_all_quantities(certificate["dcc:measurementResults"])


def _stand_in_for_dotnet():
    """dccQuantities keeps numbers in METAS UncLib, which needs .NET or Mono; without them, in `_Number`."""
    try:
        importlib.import_module("metas_unclib")
    except Exception:
        names = {"ufloat": _Number, "ucomplex": complex, "umath": types.SimpleNamespace()}
        names |= dict.fromkeys(
            ("get_value", "get_stdunc", "UniformDistribution", "ufloatfromdistribution")
        )
        sys.modules["metas_unclib"] = _module("metas_unclib", names)


def _module(name, contents):
    module = types.ModuleType(name)
    vars(module).update(contents)
    return module
