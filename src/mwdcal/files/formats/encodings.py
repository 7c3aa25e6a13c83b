"""The encoding of a text that does not state it, by the words and letters that it holds in each."""

from __future__ import annotations

import re

_ENCODINGS = (
    *("cp1252", "cp1250", "cp1254", "cp850", "mac-roman"),
    *("cp1251", "cp866", "koi8-r", "iso8859-5", "gb18030", "cp932", "cp949"),
)
"""Encodings without a mark; of two in which a text holds as much, the first is meant."""
_FIELD_WORDS = re.compile(
    r"азимут|зенит|темп|прибор|дата|угол|ускор|магн|поле|точк|номер|град|станц|"
    r"numéro|série|opérateur|étalonn|gerät|prüf|größe|übers|intensität|kanäl|número|[cs]ión\b|ç(ão|ões)\b|ângulo|"
    r"verktøy|måling|høyside|mätning|"
    r"角|温度|磁|加速度|日期|日付|序|编号|番号|工具|センサ|ツール|方位|井斜|傾斜|重力|标定|校正|仪器|機器|測定|"
    r"kąt|narzędz|świadec|całkow|przyśp|ciąż|położ|ferdeség|térerő|nehézségi|hőmérs|jegyző|gyorsulás|mágnes|"
    r"szerszám|úhel|zrychlení|měř|číslo|înclin|câmp|"
    r"방위|경사|가속도|온도|자기|번호|중력|센서|교정|복각|툴페이스|"
    r"eğim|sıra|sıcaklık|takım|açıklama|ivme|yüzü|yönelim|ölçüm|yerçekimi",
    re.IGNORECASE,
)
"""Words of the field with letters that are not ASCII."""
_CYRILLIC = "оеаинтсрвлкмдпуяыьгзбчйхжшюцщэфъёіїєґқңғүұһәө"
_ALPHABETS = (
    *("éàèùâêîôûëïüçœæ", "äöüß", "áéíóúñü", "áâãàçéêíóôõúü", "æøåéö", "åäöé", "àéèìòù"),
    *("ąćęłńóśźż", "áčďéěíňóřšťúůýž", "áéíóöőúüű", "ăâîșțşţ", "čćđšž", "çğıiöşüâî\u0307"),
    _CYRILLIC,
)
"""Letters of a language beside those of ASCII."""
_COMMONEST = frozenset("оеаинтсрвлкмд")
"""Letters of three quarters of a Russian text: other encodings have others in their place."""
_OF_ANY_LETTERS = re.compile(r"[A-Za-z]*[^\x00-\x7f\s](?:[A-Za-z]|[^\x00-\x7f\s])*")
_BEFORE_SYMBOL = re.compile("(?<=[\u0400-\u04ff])(?=[A-Z])")
"""The place between a Cyrillic word and the symbol behind it: КодAx."""
_UNIT_OR_NUMBER = re.compile("°[CF]?|µ[TVAg]|[ms]²|[Nn][º°]")
_SIGNS_AROUND = "°ºª²³µ·±×–—…“”„‘’«»§№¹®©™€¿¡‰"
_WORDS_OF_ONE_LETTER = frozenset("àéèóåØÅавикосуя")


def encoding_of(data: bytes) -> str:
    """The encoding of a text: UTF-16 by its mark or zeros, UTF-8 where it is valid, else by its words and letters."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return "utf-16"
    zeros = [data[first::2].count(0) for first in (0, 1)]
    if min(zeros) == 0 and 4 * max(zeros) > len(data):
        return "utf-16-be" if zeros[0] else "utf-16-le"
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        foreign = b"\n".join(dict.fromkeys(x for x in data.splitlines() if not x.isascii()))
        return max(_ENCODINGS, key=lambda encoding: _evidence(foreign, encoding))
    return "utf-8"


def _evidence(data: bytes, encoding: str) -> tuple[int, float]:
    """The words of the field that some bytes hold in an encoding, and how many of all words are of one language."""
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError:
        return -1, 0.0
    words_of_field = {
        match[0].lower() for match in _FIELD_WORDS.finditer(text) if not match[0].isascii()
    }
    words = set(_OF_ANY_LETTERS.findall(_BEFORE_SYMBOL.sub(" ", text)))
    units = {word for word in words if _UNIT_OR_NUMBER.fullmatch(word)}
    bare = {word.strip(_SIGNS_AROUND) for word in words - units}
    others = [word for word in bare if not word.isascii()]
    of_one = max(sum(_as_word(word, letters) for word in others) for letters in _ALPHABETS)
    return len(words_of_field), len(units) + of_one


def _as_word(text: str, letters: str) -> float:
    """How much a text looks like a word of a language of these letters, from -1 to 1.

    >>> _as_word("Gerät", "äöüß"), _as_word("Inclinaci¢n", "áéíóúñü"), _as_word("оФМ", _CYRILLIC)
    (1.0, -1.0, -1.0)
    """
    if len(text) == 1:
        return 0.0 if text in _WORDS_OF_ONE_LETTER else -1.0
    lower = text.lower()
    if text not in (lower, text.upper()) and not text[1:].islower():
        return -1.0
    if letters is _CYRILLIC:
        common = sum(letter in _COMMONEST for letter in lower) / len(lower)
        return common if {*lower} <= {*letters} else -1.0
    return 1.0 if all(letter.isascii() or letter in letters for letter in lower) else -1.0
