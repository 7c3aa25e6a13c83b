"""Statements of a table's title block about the tool, the day and who measured."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import date, datetime, timedelta
from typing import NamedTuple

import numpy as np

from mwdcal.files.formats.columns import LABELS, as_text, looks_numeric, without_marks
from mwdcal.geometry.vectors import Array

UNITS_BY_SIGN = {
    "°": "deg",
    "μ": "u",
    "µ": "u",
    "A/m": "apm",
    "мкТл": "ut",
    "нТл": "nt",
    "мВ": "mv",
    "мГал": "mgal",
    "мg": "mg",
}
"""Spellings of units in letters, by their signs and by other alphabets."""
_TITLE_WORDS = {
    "serial": "serial sn s/n n/s serialno serialnumber toolsn tools/n toolserial toolserialno toolserialnumber toolno "
    "toolid probesn probeno 仪器号 探管号 sondesn sensorsn seriennummer "
    "serie nserie seriennr geratenummer geratenr sondennummer sondennr serienummer "
    "serienr verktoynr instrumentnr numerodeserie nodeserie noserie nserie numeroserie nsserie numserie ndeserie "
    "matricola nrfabryczny numerfabryczny nrseryjny sondan sondano ferramentan ferramentano herramientan herramientano "
    "nomorseri noseri nomoralat noalat serinumarası cihazserino aletserino "
    "製造番号 製造№ sarjanumero sarjano vyrobnicislo vyrc seriovecislo 일련번호 제조번호 기기번호 serino gyariszam "
    "sorozatszam seria nrserie nrserii numarserie serianr somay soseri somaydo заводськийномер заводський№ "
    "серійнийномер серійний№ зауыттықнөмірі numardeserie serienummer "
    "заводской№ заводскойномер серийныйномер зав№ серийный№ прибор№ 序列号 编号 仪器编号 出厂编号",
    "date": "date testdate caldate calibrationdate dateofcalibration measured logged datum prufdatum "
    "messdatum dato kalibreringsdato fecha data дата датакалибровки 日期 校准日期 测试日期 标定日期 日付 "
    "교정일 날짜 측정일 tarih tanggal ngay ngayhieuchuan datacalibrarii datakalibracji datakalibrace "
    "paivamaara kuni күні",
    "operator": "operator technician measuredby testedby by bediener prufer operateur operador tecnico operatoer "
    "utfortav оператор исполнитель 操作员 检定员",
    "lab": "lab laboratory labor laboratorium laboratorio лаборатория 实验室",
}
_NUMBERS_BEHIND = ("measured", "logged", "data")
"""Words of a date that have a number of another quantity behind them as well."""
_DAYS = (
    "%Y-%m-%d",
    "%Y/%m/%d",
    "%Y.%m.%d",
    "%d.%m.%Y",
    "%d %b %Y",
    "%d-%b-%Y",
    "%d %B %Y",
    "%Y年%m月%d日",
)
"""Forms of a day that can be read in one way only; in Germany, Norway and Russia a point stands behind the day."""
_MONTHS = (
    r"jan\w*|ene\w*|gen\w*|ian\w*|янв\w*|січ\w*|oca\w*|sty\w*|led\w*|tammi\w*",
    r"feb\w*|fev\w*|фев\w*|лют\w*|sub\w*|lut\w*|unor\w*|helmi\w*",
    r"mar\w*|maart|mrt|maerz|mac|мар\w*|берез\w*|brez\w*|maalis\w*",
    r"apr\w*|abr\w*|avr\w*|апр\w*|квіт\w*|nis\w*|kwi\w*|dub\w*|apir\w*|huhti\w*",
    r"ma[iyj]\w*|mei|mag\w*|ма[ия]\w*|трав\w*|kvet\w*|touko\w*",
    r"jun\w*|jui?n|giu\w*|iun\w*|июн\w*|черв\w*|haz\w*|cze\w*|cerv(en|na)|kesa\w*",
    r"jul\w*|juil\w*|lug\w*|iul\w*|июл\w*|лип\w*|tem(muz)?|lip\w*|cervenec|cervence|heina\w*",
    r"aug\w*|ago\w*|aou\w*|авг\w*|серп\w*|agu\w*|sie\w*|srp\w*|elo\w*",
    r"sep\w*|set\w*|szep\w*|сен\w*|вер\w*|eyl\w*|wrz\w*|zari\w*|syys\w*",
    r"o[ck]t\w*|ott\w*|out\w*|окт\w*|жовт\w*|eki\w*|paz\w*|rij\w*|loka\w*",
    r"nov\w*|nop\w*|noi\w*|ноя\w*|лист\w*|kas\w*|lis\w*|marras\w*",
    r"de[czks]\w*|dic\w*|dez\w*|дек\w*|груд\w*|ara(lik)?|gru\w*|pros\w*|joulu\w*",
)
"""Beginnings of the months in the languages of laboratories, without marks."""
_IN_WORDS = (
    re.compile(
        r"(?P<d>\d{1,2})(?:st|nd|rd|th|er|\.|º|°|-?го)?[\s-]*(?:d[ei]l? )?(?P<m>[^\W\d_]{3,})\.?,?[\s-]*(?:d[ei]l? )?"
        r"(?P<y>(?:19|20)\d\d)(?:\s*(?:г\.?|года?|р\.?|року))?"
    ),
    re.compile(
        r"(?P<m>(?:jan|feb|mar|apr|may|jun|jul|aug|sep|oct|nov|dec)[a-z]*)\.? (?P<d>\d{1,2})(?:st|nd|rd|th)?,?\s+"
        r"(?P<y>(?:19|20)\d\d)"
    ),
    re.compile(r"(?P<y>(?:19|20)\d\d)\.?,?[\s-]+(?P<m>[^\W\d_]{3,})\.?[\s-]*(?P<d>\d{1,2})\.?"),
)
"""Forms of a day with the month in words."""
_IN_NUMBERS = re.compile(
    r"(?P<y>(?:19|20)\d\d)\s*[年년]\s*(?P<m>\d{1,2})\s*[月월]\s*(?P<d>\d{1,2})\s*[日일]|"
    r"(?:ngay )?(?P<day>\d{1,2}) thang (?P<month>\d{1,2}) nam (?P<year>(?:19|20)\d\d)"
)
"""Forms of a day with the words for year, month and day."""
_MONTH_FIRST = re.compile(
    r"(?<![^\W\d_])([^\W\d_]{3,9}\.? \d{1,2}(?:st|nd|rd|th)?),\s+(?=(?:19|20)\d\d\b)"
)
"""A month and a day before the comma and the year: August 22, 2024."""
OF_REFUSAL = (
    r"reject(ed)?|bad|invalid|void|voided|discard(ed)?|unusable|omit(ted)?|excluded?|scrap(ped)?|do not use|dnu|"
    r"n\.? ?ok|nok|not ok|no good|n\.o\.k\.?|verworfen|ungultig|schlecht|fehlmessung|unbrauchbar|gestrichen|"
    r"ausgeschlossen|skip(ped)?|verwerfen|streichen|"
    r"desc[ae]rt(ar|e)|exclu(ir|ye)|rechazar|rejeitar|anular|forkastes?|strykes?|отбросить|исключить|"
    r"nicht (ok|verwenden|verwertbar)|n\.? ?i\.? ?o\.?|forkastet|ugyldig|darlig|underkjent|avvist|kassert|"
    r"strøket|stroket|feilmaling|"
    r"ikke (ok|bruk|brukes)|rechazad[oa]|invalid[oa]|descartad[oa]|anulad[oa]|no (ok|usar|valid[oa])|mal[oa]?|"
    r"rejeitad[oa]|ruim|nao (ok|usar)|rejete?e?|mauvaise?|annulee?|ecarte|non ok|брак|забракован[оа]?|отбракован[оа]?|"
    r"a rejeter|not used|unused|scartat[aeio]|ongeldig|afgekeurd|無効|除外|"
    r"cancell?ed|not (accepted|valid)|"
    r"gecersiz|iptal( edildi)?|reddedildi|hatal[ıi]|bozuk|[cç][ıi]kar[ıi]ld[ıi]|"
    r"odrzuc(on[aeoy]|ic)|uniewaznion[aeoy]|niewazn[aey]|b[lł]edn[aey]|anulowan[aey]|skreslon[aey]|pominiet[aey]|"
    r"wykluczon[aey]|do (odrzuceni|usunieci)a|nieprawid[lł]ow[aey]|"
    r"ditolak|tidak (valid|sah|ok)|batal|dibatalkan|dibuang|gagal|"
    r"(da )?scartare|non valid[aeio]|annullat[aeio]|esclus[aeio]|rifiutat[aeio]|"
    r"invalide|non valide|a (exclure|eliminer|ecarter)|exclue?|eliminee?|supprimee?|non retenue?|"
    r"excluid[oa]|eliminad[oa]|cancelad[oa]|desechad[oa]|(nao|no es) valid[oa]|"
    r"niet (geldig|ok|goed)|verworpen|vervallen|respins[ae]?|anulat[ae]?|eliminat[ae]?|exclus[ae]?|nevalid[ae]?|"
    r"neplatn[aeioy]|vyrazen[aoy]?|zamitnut[aoy]|vyloucen[aoy]?|chybn[aey]|ogiltig\w*|underkan[dt]\w*|kasserad\w*|"
    r"hylatty|ervenytelen|elvetve|відхилен\w*|недійсн\w*|жарамсыз|қабылданбады|مرفوض|غير صالح|"
    r"плохо|плохая|не ?год(ен|на|но)|недейств\w*|исключ\w*|не использовать|отклонен[оа]?|не ок|"
    r"作废|剔除|无效|废弃|舍弃|弃用|不可用|坏点?|不合格"
)
"""Words by which a laboratory rejects a row, or a whole run."""
NOT_TO_USE = (
    r"(do|does|is|was|are)? ?not (to be )?used?|not? for (the )?(cal\w*|use|evaluation|fit)|never (to be )?used?|"
    r"unused|disregard|"
    r"nicht (zu )?(verwend\w*|benutz\w*|werten)|nicht (fur|zur) (die )?(kal\w*|auswertung)|"
    r"ikke (bruk\w*|benytt\w*)|(brukes|benyttes|skal) ikke( brukes| benyttes)?|ikke (for|til) kal\w*|"
    r"(brukes|benyttes) ikke (for|til) kal\w*|"
    r"no (usar|utilizar|usad[oa]|utilizad[oa])|no se (usa|utiliza)|no para (la )?cal\w*|"
    r"nao (usar|utilizar|usad[oa]|utilizad[oa])|nao para (a )?cal\w*|"
    r"ne pas (utiliser|prendre)|non utilisee?|pas pour l.(etalonnage|ajustage)|non (usare|usat[oa]|utilizzat[oa])|"
    r"не (использовать|используется|учитывать|учитывается)|не для (калибр|град)\w*|"
    r"(to be )?ignored?|a ignorer|desconsidera(r|d[oa])|(di)?abaikan|"
    r"kullan[ıi]lma\w*|kullanma(y[ıi]n)?|dikkate al[ıi]nma\w*|nie (uzywac|uzyt[aey]|liczyc|brac|uwzgledni\w*)|"
    r"(tidak|jangan) (dipakai|digunakan|pakai)|niet (gebruiken|gebruikt|meenemen)|nu (se )?(folos\w+|utiliz\w+)|"
    r"nepouzi\w*|ej anvand\w*|не використ\w*|есепке алынба\w*|қолданба\w*|"
    r"不用|不使用|不采用|不参与(校准|标定|计算)?|不用于(校准|标定|计算)"
)
"""Words by which a laboratory says that a row does not count."""
ADJUSTED = re.compile(
    r"as[- ]?left|(before|after|pre|post)[- ]?(adjust|calib)\w*|(vor|nach) (der )?(justier|abgleich|kalibrier)\w*|"
    r"(f(ø|o)r|etter|efter) (juster|kalibrer)\w*|(antes|despu[eé]s|depois) (del?a?|do|da) (ajust|calibr)\w*|"
    r"(avant|apr[eè]s) (ajust|r[eé]glage|[eé]talonn)\w*|(до|после) (регулир|настрой|юстир|калибр)\w*|"
    r"(校准|调整|调校)(前|后)|(調整|校正)(前|後)",
    re.IGNORECASE,
)
"""Words of a run before or after an adjustment of the tool: two of them are two runs."""
_PARTS = re.compile(r"\s+/\s+|,\s+|;\s*|\s{3,}")
"""The separator of facts in one cell."""
_OF_TOOLS = (
    "tool|probe|sensor|sonde|sonda|prüfling|instrument|herramienta|ferramenta|verktøy|gerät|equipo|equipamento|"
    "alat|alet|cihaz|прибор|зонд|датчик|инклинометр|仪器|探管"
)
_TOOL = re.compile(
    rf"#?\s*(?:(?:{_OF_TOOLS})(?:n?-|\s*)"
    r"(?P<mark>s/?n|n/s|serial( no)?|n[°º]|n(?=\s+\d)|no\b|nr\b|зав\.?\s*№|№|#|号|编号)?|(?P<sn>sn|s/n|"
    r"serial no))\s*[.:：|=]*\s*",
    re.IGNORECASE,
)
_TOOL_ALONE = re.compile(
    rf"\W*(?:{_OF_TOOLS}|unit|outil)\s*\W{{0,3}}\s*(?P<name>[A-Z]|(?=\S*\d)\w[\w./-]*)\W*",
    re.IGNORECASE,
)
"""A line that is the word for the tool and a number, or a letter, and nothing else."""
_SERIAL = re.compile(r"(?=\S*\d)[^\W_](?:[\w./-]*[^\W_])?")
_OF_TWO = r"(?!\d{1,4}[./-]\d\d?[./-]\d{1,4}(?!\d))(?=\S*\d)[^\W_][\w./-]*"
_WHOLE_SERIAL = rf"{_SERIAL.pattern}(?:\s+/\s+{_OF_TWO})?"
"""A serial, which may be of two numbers, a model and its own: BHX-72 / 0091. A day is not a number."""
_TWO_NUMBERS = re.compile(rf"(?<!\S)({_OF_TWO})(\s+/|,)\s+(?={_OF_TWO}\s*$)")
_NUMBER_OF_TOOL = re.compile(
    r"(tool|probe|sensor|sonde|modul[eo]?|instrument|herramienta|ferramenta|equipo|equipamento|verktoy|gerat|alat|alet|cihaz|"
    r"прибор|зонд|датчик)(s|n|e|en)?(s/?n|n/s|serial(n|no|nr|num|number)?|n|no|nr|num|number|nummer|numero|№|номер|id)|"
    r"(номер|numero|nummer|number|n|no|№)(d[eao]l?a?|of|der|des)?"
    r"(прибора|зонда|датчика|инклинометра|herramienta|ferramenta|equipo|equipamento|sonda|sonde|tool|probe)"
)
"""The word for the tool and one for a number, without marks and blanks."""
_BEHIND_MODEL = re.compile(
    rf"(?<![^\W\d_])(?:{_OF_TOOLS})\w*[\s:]+[\w./-]+\s+(?:s/?n|serial(?: no)?|n[°ºr]|no\b|зав\.?\s*№|№)\s*[.:]?\s*"
    rf"({_SERIAL.pattern})",
    re.IGNORECASE,
)
"""The word for the tool, its model, and its serial behind a mark: Sonde SD-9 n° 112."""
_OF_CAPITALS = r"[A-ZА-Я]{1,5}\d{0,3}[-/]?\d[\w/-]*"
_BY_NAME = re.compile(
    rf"(?i:{_OF_TOOLS}|modul)(?i:[a-zа-яё]{{0,3}})(?: (?i:nr|no)\.)?\s*:?\s+"
    rf"(?P<tool>{_OF_CAPITALS}|[A-ZА-Я]{{1,5}}(?:-[A-ZА-Я]{{1,5}})? (?!(?:19|20)\d\d\b)\d{{1,6}}(?:(?: / |-)\d+)?)"
    r"(?![\w.,°-])"
    r"(?!\s*(?i:n[°ºr]|no\b|№|s/?n))|"
    r"^\W*(?i:\w*(?:kalibr|calibra|justier)\w*|(?:калибр|тариров|градуиров)\w*|标定|校准)\s+"
    rf"(?P<run>{_OF_CAPITALS})(?![\w.°])"
)
"""A serial of capitals and digits behind a word for the tool or, where a line begins, for its calibration."""
_WITH_MARK = re.compile(
    r"(?:(?<![^\W\d_])|(?<=[\u4e00-\u9fff]))(?:(?P<word>serial(?:[ -]?(?:number|num|no|nr))?|"
    r"(?:[^\W\d_]+-?)?serien?-?(?:nummer|nr)|"
    r"(?:n[°ºo.r]*|n[uú]m\w*|nr)\.? (?:d[ei] )?(?:s[eé]ri[ea]l?|fabr\w*|seryjny)|"
    r"s[eé]ri[ea](?!\s+\d{1,2}(?![\w./-]))|"
    r"fabr(?:ik)?\.?[ -]?(?:nr|nummer)|matricola|"
    r"зав\w*\.? ?(?:№|номер|n)|серийн\w* ?(?:№|номер)|seri ?no|序列号|编号|製造番号)|s\.?/?n|[^\W\d_]+[ -]sn|"
    r"(?<=[,(;] )(?:n[°ºr]\.?|num[eé]ro|№))\.?"
    rf"(?:\s+(?:{_OF_TOOLS}))?[\s.:：=#|;]*(?P<serial>{_WHOLE_SERIAL})",
    re.IGNORECASE,
)
"""A word of a serial number in a line, and the serial behind it."""
_OF_EQUIPMENT = re.compile(
    r"stand|table|tisch|bench|banco|oven|ofen|chamber|thermo|logger|volt|multimeter|gauss|"
    r"magnetom|theodol|referen[cs]|referenz|referans|normal|patr[oó]n|étalon|acuan|(kalibrasyon|ölçüm)\s*$|"
    r"стенд|печь|эталон|转台|参考",
    re.IGNORECASE,
)
"""Words of what is not the tool, and has a serial as well."""
_TELLING = re.compile(r"(?=.*\d).*[^\W\d_].*|\d+-\d+")
"""A serial that shows by itself: letters beside digits, or a dash between them."""
_ENGLISH_DATE = re.compile(
    r"\W*(test|cal\w*)?\s*(date|day|time|utc|timestamp|measured)", re.IGNORECASE
)
_TRUE_NORTH = re.compile(
    r"true\s+north|geographic north|nord géographique|rechtweisend", re.IGNORECASE
)
_WEST_WORD = (
    r"west\w*|ouest|oeste?|ovest|vest\w*|v[äa]st\w*|зап\w*|za(?:ch|hod)\w*|z[áa]pad\w*|bat[ıi]|西"
)
_SENSE = rf"[ew]|{_WEST_WORD}|east\w*|est|este|leste|ost|øst|öst|вост\w*"
_LETTERS_OF_SENSE = (
    (r"deklin[aáā]c|declinac(j|e\b)|odchyl", "e", "z"),
    (r"miss?v|dekl|(meridian)?konv", "eoöø", "wv"),
    (r"d[eé]clin(a[cçz]|ai)|convergencia", "el", "wo"),
    (r"[а-я]", "eв", "wз"),
    (r"[\u4e00-\u9fff]", "e东東", "w西"),
    (r"manyetik", "ed", "wb"),
    (r"", "e", "w"),
)
"""The letters for east and for west in the language of a word for the declination; any other is not understood.

V is west in Norwegian and Lithuanian, and east in Czech and Slovene.
O is east in German and west in French, W is east in Polish.
"""
_TURN_EAST = (
    r"(?:\s+mag[^\W\d_]*)?(?:\s+(?:at|am|ved|en|in|on)\s+(?:the\s+)?[^\W\d_]+)?"
    rf"(?P<note>(?:[\s,;:]*(?:\([^)]*\)|\[[^\]]*\]|(?:deg\w*|grad\w*|gra[du][os]?s?|град\w*|гр|positive|{_SENSE})(?![^\W\d_])))*)"
    r"[^\w+−-]*(?P<degrees>[+−-]?\d+[.,]?\d*)\s*(?:°|deg\w*\.?|gra[du]\w*|град\w*|гр)?"
    r"(?:\s*(?P<minutes>\d+(?:[.,]\d+)?)\s*(?:['′’]|min\w*))?"
    r"\s*[(\[]?(?:(?:mot|nach|to\w*|the|al?|hacia|vers)\s+)*(?P<sense>(?P<symbol>[BFGHI](?=\W*\d))|[^\W\d_]++)?"
)
_DECLINATION_WORD = re.compile(
    r"((?:decl|dekl|décl)\w*|miss?visning|склонени\w*|схилення|偏角|manyetik sapma|odchylenie magn\w*)",
    re.IGNORECASE,
)
_DECLINATION = re.compile(_DECLINATION_WORD.pattern + _TURN_EAST, re.IGNORECASE)
_WEST_POSITIVE = re.compile(rf"\b(w|{_WEST_WORD})\b\W*(\+|pos)", re.IGNORECASE)
"""A sense that counts as positive, in brackets: (° W +)."""
_WEST = re.compile(
    rf"(\W*(deg\w*|grad\w*|gra[du][os]?s?))?\W*(w|{_WEST_WORD})(\W*(deg\w*|grad\w*|gra[du][os]?s?))?\W*",
    re.IGNORECASE,
)
"""The whole of such words: (W), (° west), W [deg]."""
_NO_DEGREES = re.compile(
    r"(?<![^\W\d_])(m?rad|gon|min|arc\w*|sec|mils?|nt|[uµ]t|uncert\w*|\d?σ|sd|per|change|drift)(?![^\W\d_])|/|['′’%±]",
    re.IGNORECASE,
)
"""Words behind a declination of another unit than degrees, or of another quantity."""
_CONVERGENCE = re.compile(
    r"(convergence|konvergenz|meridiankonvergens|convergencia|сближение меридианов|收敛角)"
    + _TURN_EAST,
    re.IGNORECASE,
)
_SPECIAL_LETTERS = str.maketrans({"ø": "o", "Ø": "O", "ß": "ss", "º": "", "ª": "", "°": ""})


class Titles(NamedTuple):
    """Metadata by key, and a day that may be read in two ways, as it stands.

    `not_taken` are lines with a nominal or approximate reference, by column of a run file; `choices` are references
    of which lines state different values, or serials of sheets; `others` lines with another value than the one
    taken, and it.
    """

    metadata: Mapping[str, object]
    unclear_day: str = ""
    not_taken: Mapping[str, str] = {}
    choices: Mapping[str, tuple[float | str, ...]] = {}
    others: Mapping[str, tuple[str, float]] = {}


def titles(rows: Sequence[Sequence[object]]) -> Titles:
    """What rows above a table say: a key with a colon and its value, or a key and the cell to the right.

    A serial may stand behind the word for the tool, if it has letters or a dash beside digits; a day alone is the
    date where no other is named.

    >>> titles([["Tool S/N:", "A-17", "", "Date", "14.03.2025"]]).metadata
    {'serial': 'A-17', 'date': '2025-03-14'}
    >>> titles([["Sensor M-0915, 06.03.2026"]]).metadata
    {'serial': 'M-0915', 'date': '2026-03-06'}
    """
    metadata: dict[str, object] = {}
    unclear, days, tools = "", dict[str, None](), dict[str, None]()
    declination = convergence = None
    true = False
    for row in rows:
        whole = [as_text(cell).strip() for cell in row]
        cells = [part.strip() for cell in whole for part in _parts(cell)]
        text = " ".join(whole)
        declination = _rotation(_DECLINATION, text) if declination is None else declination
        convergence = _rotation(_CONVERGENCE, text) if convergence is None else convergence
        true = true or bool(_TRUE_NORTH.search(text) and "?" not in text)
        marked = _marked_in(" ; ".join(whole)) or _BEHIND_MODEL.findall(text) or _named_in(text)
        for place, cell in enumerate(cells):
            key, value = _pair(cell, cells[place + 1 :])
            days |= dict.fromkeys(filter(None, [day_of(cell)]))
            tools |= dict.fromkeys(filter(None, marked or [_tool(cell, cells[place + 1 :])]))
            if not value or key in metadata:
                continue
            if key == "date":
                day = day_of(value, not _ENGLISH_DATE.match(cell))
                unclear = unclear or ("" if day else value)
                value = day
            if value:
                metadata[key] = value
    lone = filter(None, [_day_of_number(unclear)]) if unclear else days
    for key, others in (("serial", [*tools]), ("date", [*lone])):
        if key not in metadata and len(others) == 1:
            metadata[key] = others[0]
    if declination is not None:
        metadata |= {"declination_deg": declination} | (
            {"azimuth_reference": "true"} if true else {}
        )
    if convergence is not None:
        metadata["convergence_deg"] = convergence
    return Titles(metadata, "" if "date" in metadata else unclear)


def tool_in(row: Sequence[object]) -> str:
    """The tool that a line between rows of readings states: its serial or a number alone, or else empty.

    >>> tool_in(["Tool 4092"]), tool_in(["S/N A-17"]), tool_in(["Tool warm"])
    ('4092', 'A-17', '')
    """
    match = _TOOL_ALONE.fullmatch(" ".join(filter(None, map(as_text, row))))
    return match["name"] if match else str(titles([row]).metadata.get("serial", ""))


def _parts(cell: str) -> list[str]:
    """The facts in a cell; of a key in two languages (Serial / Serie) the first."""
    whole = _MONTH_FIRST.sub("\\1 ", _TWO_NUMBERS.sub("\\1\\2\0", cell))
    parts = [part.replace("\0", " ") for part in _PARTS.split(whole)]
    label = len(parts) > 1 and _word(parts[0]) in _MEANT and not re.search(r"[\d:=]", cell)
    return parts[:1] if label else parts


def _rotation(statement: re.Pattern[str], text: str) -> float | None:
    """The declination or convergence that a line states with its sense or sign, degrees east."""
    match = statement.search(text)
    if not match:
        return None
    degrees, minutes = (
        float((match[n] or "0").replace(",", ".").replace("−", "-")) for n in ("degrees", "minutes")
    )
    value = math.copysign(abs(degrees) + minutes / 60, -1 if match["degrees"][0] in "-−" else 1)
    if abs(value) > 180:
        return None
    note, behind = match["note"] or "", match["sense"] or ""
    if _NO_DEGREES.search(note):
        return None
    if _WEST_POSITIVE.search(note) or (behind and _WEST_POSITIVE.match(text, match.start("sense"))):
        return -value
    letters = re.findall(r"(?<![^\W_])[^\W\d_](?![^\W_])", note)
    senses = [_sense(match[1], each) for each in letters]
    senses.append(_sense(match[1], behind) or (1 if match["symbol"] else None))
    if None in senses:
        return None
    return -abs(value) if -1 in senses or _WEST.fullmatch(note) else value


def _sense(word: str, text: str) -> int | None:
    """The sense of a text beside a declination that is called by a word: -1 west, else 1; None of an unknown letter."""
    if re.fullmatch(_WEST_WORD, text, re.IGNORECASE):
        return -1
    if len(text) != 1:
        return 1
    _, east, west = next(each for each in _LETTERS_OF_SENSE if re.match(each[0], word.lower()))
    return 1 if text.lower() in east else -1 if text.lower() in west else None


def unread_declination(text: str) -> bool:
    """Whether a line speaks of a declination and has a number, which `titles` did not read.

    >>> [unread_declination(text) for text in ("Declination [rad] 0.04", "Declination by IGRF13", "Dip 65.3")]
    [True, False, False]
    """
    word = _DECLINATION_WORD.search(text)
    return bool(
        word and re.search(r"(?<![\w.,])[+−-]?\d+(?:[.,]\d+)?(?![\w-])", text[word.end() :])
    )


def _marked_in(text: str) -> list[str]:
    """The serials behind a word for one in a line; those behind a whole word before those behind letters."""
    every = [
        m
        for m in (() if text.startswith("TOA5") else _WITH_MARK.finditer(text))
        if not _OF_EQUIPMENT.search(re.split(r"[;,]|\.\s", text[: m.start()].rstrip(" ;,"))[-1])
    ]
    return [m["serial"] for m in every if m["word"]] or [m["serial"] for m in every]


def _named_in(text: str) -> list[str]:
    """The serials by which a line names the tool, where no mark says so.

    >>> _named_in("MWD sonde T-2209 tumble"), _named_in("Kalibrering H-90, Oslo"), _named_in("Calibration 2026")
    (['T-2209'], ['H-90'], [])
    """
    each = (m for m in _BY_NAME.finditer(text) if not _OF_EQUIPMENT.search(text[: m.start()]))
    return [m["tool"] or m["run"] for m in each]


def _tool(cell: str, right: Sequence[str]) -> str:
    """The serial behind a word for the tool, in a cell or the next one; empty where that may be something else."""
    marked = (m for m in _TOOL.finditer(f" {cell}") if m["mark"] and m[0][0].isspace())
    last = _TOOL.fullmatch(cell, max(cell.rfind(" "), cell.rfind("-")) + 1)
    match = _TOOL.match(cell) or last or next(marked, None)
    if not match or _OF_EQUIPMENT.search(match.string[: match.start()]):
        return ""
    behind = match.string[match.end() :].strip() or next((each for each in right[:2] if each), "")
    number = _SERIAL.match(behind)
    alone = number and number[0] == behind and re.search(r"[:：=|]\s*$", match[0])
    clear = match["mark"] or match["sn"] or alone
    return number[0] if number and (clear or _TELLING.search(number[0])) else ""


def _pair(cell: str, right: Sequence[str]) -> tuple[str, str]:
    """The key that a cell is, and its value behind a colon, a sign or in the next cell that is filled in."""
    head, *tail = re.split(r"\s*[:：=|]\s*", cell, maxsplit=1)
    first, _, behind = cell.partition(" ")
    if _MEANT.get(_word(first)) == "date" and day_of(behind, True):
        return "date", behind
    word = _word(head.lstrip("#"))
    inside = [_MEANT.get(_word(text)) for text in re.findall(r"[(\[](.*?)[)\]]", head)]
    key = _MEANT.get(word, "serial" if _NUMBER_OF_TOOL.fullmatch(word) else "")
    key = key or ("serial" if "serial" in inside and not _OF_EQUIPMENT.search(head) else "")
    if not key:
        return "", ""
    value = "".join(tail).strip(' "') or next(
        (each.lstrip(":= ") for each in right[:3] if each), ""
    )
    return ("", "") if word in _NUMBERS_BEHIND and looks_numeric(value) else (key, value)


def _word(text: str) -> str:
    """Letters of a text in lower case without marks and blanks."""
    return re.sub(r"[^\w/№]|_", "", without_marks(text.translate(_SPECIAL_LETTERS).lower()))


def day_of(text: str, day_first: bool = False) -> str:
    """A day in ISO form; empty where it may be read in two ways, or is no day. A time may stand behind it.

    `day_first`: of 03/04/2025 the 3 is the day, as everywhere but in English. With AM or PM the month is first.
    """
    first, *time = re.split(r"[T ]+(?=\d\d?:)", text.strip(), maxsplit=1)
    first = re.sub(r"(?<=\d)\.\s+(?=\d)", ".", first)
    first = first.rstrip(".") if first.count(".") == 3 else first
    for form in _DAYS:
        try:
            return datetime.strptime(first, form).date().isoformat()
        except ValueError:
            continue
    if day := _day_in_words(first):
        return day
    match = re.fullmatch(r"(\d\d?)([/.-])(\d\d?)\2(\d{4})", first)
    if not match:
        return ""
    one, two = int(match[1]), int(match[3])
    american = bool(time) and time[0].rstrip(".").upper().endswith(("AM", "PM"))
    orders = [(one, two)] if day_first else [(two, one)] if american else [(one, two), (two, one)]
    days = {f"{match[4]}-{m:02d}-{d:02d}" for d, m in orders if 0 < m <= 12 and 0 < d <= 31}
    return days.pop() if len(days) == 1 else ""


_DAY_NUMBERS = (36_526, 73_050)
"""Numbers that a workbook has for the first day of 2000 and for the last of 2099."""


def _day_of_number(text: str) -> str:
    """The day of a number of days since 30 December 1899, as a workbook stores it; empty where it is no such number.

    >>> _day_of_number("46350"), _day_of_number("2026")
    ('2026-11-24', '')
    """
    days = int(text) if re.fullmatch(r"\d{5}", text) else 0
    first, last = _DAY_NUMBERS
    return (date(1899, 12, 30) + timedelta(days)).isoformat() if first <= days <= last else ""


def _day_in_words(text: str) -> str:
    """A day whose month is a word of any language, or a number with the word for a month; in ISO form.

    >>> [_day_in_words(t) for t in ("21 de mayo de 2024", "August 22, 2024", "2024년 2월 21일", "14. Mai", "1 st 2024")]
    ['2024-05-21', '2024-08-22', '2024-02-21', '', '']
    """
    plain = without_marks(text.translate(_SPECIAL_LETTERS).lower())
    match = _IN_NUMBERS.fullmatch(plain)
    if match:
        year, month, day = (
            match[short] or match[long] for short, long in zip("ymd", _PARTS_OF_DAY, strict=True)
        )
    elif match := next(filter(None, (form.fullmatch(plain) for form in _IN_WORDS)), None):
        months = [k for k, words in enumerate(_MONTHS, 1) if re.fullmatch(words, match["m"])]
        year, month, day = match["y"], str(months[0] if len(months) == 1 else 0), match["d"]
    else:
        return ""
    try:
        return date(int(year), int(month), int(day)).isoformat()
    except ValueError:
        return ""


_PARTS_OF_DAY = ("year", "month", "day")


def dated(
    metadata: Mapping[str, object], columns: Iterable[tuple[str, Sequence[str] | Array]]
) -> dict[str, object]:
    """Metadata with the one day of all cells of a column of dates or times, where they have no date."""
    if "date" in metadata:
        return dict(metadata)
    day = next((day for _, day in columns_of_a_day(columns)), "")
    return {**metadata, "date": day} if day else dict(metadata)


def columns_of_a_day(
    columns: Iterable[tuple[str, Sequence[str] | Array]],
) -> Iterator[tuple[str, str]]:
    """The columns of dates or times all cells of which are of one day, and that day."""
    for name, cells in columns:
        if name in LABELS or isinstance(cells, np.ndarray):
            continue
        day, first = "", not _ENGLISH_DATE.match(name)
        for cell in dict.fromkeys(filter(None, cells)):
            each = "" if looks_numeric(cell) else day_of(cell, first)
            if not each or (day and each != day):
                day = ""
                break
            day = each
        if day:
            yield name, day


_MEANT = {_word(word): key for key, words in _TITLE_WORDS.items() for word in words.split()}
