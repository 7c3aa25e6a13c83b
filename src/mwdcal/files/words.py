"""Words of other languages and programs for what the columns of a table hold, in the words of the field."""

from __future__ import annotations

import re
import unicodedata
from functools import lru_cache

from mwdcal.files.formats.columns import without_marks
from mwdcal.files.synonyms import resembled

_LATIN = str.maketrans({"ø": "o", "Ø": "O", "æ": "ae", "ß": "ss", "ł": "l", "ı": "i", "İ": "i"})
"""Letters that do not come apart into a plain letter and a mark."""
_LOOKALIKE = re.compile(r"(?<![^\W\d_])([GABHMАВНМ]?[ХхУу]|[АВНМ][xyzXYZ])(?![^\W\d_])")
"""An axis in Cyrillic letters, or a channel in letters of both alphabets."""
LATIN_AXES = str.maketrans("АВНМХхУу", "ABHMXxYy")
"""Cyrillic letters of axes and channels, and those that they look like."""
_ELEVATION = (
    r"\b(elev(ation)?|hole dip|elevacion|elevacao|elevazione|elewacj[ai]|elevasi|elevace|elevatie|yukselim|hoydevinkel|"
    r"inc\w* (from|to|above|over) (the )?horiz\w*|pitch)\b"
)
"""Names of angles that count from the horizontal."""
_CROSSWISE = (
    r"(tran(s|sv|sverse|sversal\w*)?|radiale?|lateral|cross|quer(achse)?|tverr|радиальн\w*|поперечн\w*|径向|横向)"
    r"\.?[ _-]*"
)
"""Words of an axis across the tool, before its number."""
_FROM_VERTICAL = (
    r"(from|to|zur|vo[nm]( der)?|fra|av|de la|a la|da|dalla|dari|od|par rapport a la|от) (the )?"
    r"(vertical\w*|vertikal\w*|lotrechten|lotlini?e|lot|loddlinjen?|lodd(et)?|вертикали|pionu|svislice)\b"
)
"""Words of an angle that counts from the vertical, as an inclination does."""
TRANSLATIONS = (
    (r"(roll|rulle|dreh)[ _-]?(sett?|gruppe|satz)|\bsett\b|serie de giro|серия|组号", "group "),
    (
        r"serien?-?(n|numme)r\b\.?|serienumm?er|\bser\. ?n[ro]\b\.?|\bn[.º°]? ?(de )?serie\b|numero (de )?serie|"
        r"\bзав(одской)?\b\.? ?(№|no|номер)|\bn/s\b|(仪器|工具|探管)编?号",
        "serial ",
    ),
    (r"\bdeg(rees|\.)? ?(m|mag)\b", "deg"),
    (r"\bdeg(rees|\.)? ?(t|true)\b", "true deg"),
    (r"\bdeg(rees|\.)? ?(g|grid)\b", "grid deg"),
    (r"\|\s*b\s*\|", "Btotal"),
    (r"\|\s*g\s*\|", "Gtotal"),
    (r"pruf(?=stand)|mess(?=stand)", ""),
    (r"(?<=\b[ag][xyz])[ _]+acc?el\w*\b", ""),
    (r"\binc['’]n\b", "inclination "),
    (r"\baz['’](th|m)\b", "azimuth "),
    (r"\brot['’]n\b", "toolface "),
    (
        r"\b(raw( values?| data| readings?)?|rohwerte?|rohdaten|rohsignale?|(ra)verdi(er)?|radata|"
        r"valor(es)? (bruto|crudo)s?|сыр\w*|исходн\w*)\b[\W_]*(?=[^\W\d_]{3})|原始(数据|值)?(?=.)",
        "",
    ),
    (
        r"(?<![^\W\d_])(bohrloch|borehull?s?|boreh(ole)?\b|wellbore|kuyu|hole(?= (azi|dire)))[ ._-]*(?=[^\W\d_])",
        "",
    ),
    (r"\bmag(netic)?\b\.? (north|nord|norte)\b", "mag"),
    (r"(?<=[°º] )[СсC]\b|(?<=[°º])[СсC]\b", "C"),
    (r"(?<![^\W\d_])([CF])°", r"°\1"),
    (r"\bm(illi)?gauss\b", "mG"),
    (r"\bmgn\b\.?", "mag"),
    (r"合成?(?=磁|重力|加速度)|\b(betrag|summe|somme|suma|soma|сумм\w*)\b", "sum "),
    (
        r"(drehtisch|turn ?table|rotary table)"
        r"(?=[ _:,-]*(magn?\b\.?|magn\w*)?[ _-]*(zen|neig|in[ck]|kipp|roll|azi|(ver)?dreh|tool|tf|hoch|schwenk))",
        "ref ",
    ),
    (r"grav(?=axial|tran)", "acc "),
    (r"(?<=\b[abghm][xyz])[ _]+(axial|trans\w*|quer|tverr|trv)\b\.?", ""),
    (r"axiale?|aksial|longitudinal\w*|langsachse|осев\w*|轴向", "Z "),
    (rf"{_CROSSWISE}1", "X "),
    (rf"{_CROSSWISE}2", "Y "),
    (rf"{_CROSSWISE}(?=[xyz]\b)|\baxe(?=[ _]*[xyz]\b)", ""),
    (
        r"\b(angulo|angle|ang)\b\.?( d[ae]l?\b)?( d')? *(?=inclin|azim|acim|rot|rol|roul|giro|cara|face)",
        "",
    ),
    (
        r"(?<=[xyz][ -])(magnet(feld|felt)|magn\b\.?)|(?<=[xyz])轴?磁(场强度|场|通门|力计|力|强计)?",
        " mag ",
    ),
    (
        r"hoehenwinkel|hohenwinkel|elevasjon|stupning|neigung.*horizontal\w*|угол места|仰角|"
        r"(井斜|倾)?角?\W*(与|和|从|自)?水平面?的?(夹)?角|" + _ELEVATION,
        "elevation ",
    ),
    (
        r"inklination( des)? (erd)?(magnet)?felde?s?|"
        r"복각|magneettinen kaltevuus|magn\w* kaltevuus|magneticka inklinace|inklinace (mag\w*|pole)|"
        r"manyetik (egi[mk]\w*|dalim)|\bdalim\b|магнит\w* (өріс\w* )?көлбеу\w*|"
        r"inklinacj[ai]( pola| magn\w*)?|magn\w* inklinacio|inclinazione magn\w*|magn\w* inclinatie|"
        r"\bfall(vinkel)?\b|magn\w* (inklination|lutning)|inklinasi( magnet\w*)?|伏角|"
        r"(угол )?(магнитн\w* )?наклонени[ея]|\bдип\b|(地磁|磁)倾角?|incl\w*\.? magn\w*\.?|"
        r"(magn\w*|felt|feld|field) ?[-_ ]?inkl\w*|mergulho( magn\w*)?|echado|buzamiento|(field|magnetic) inclination",
        "dip ",
    ),
    (
        rf"(angul[oe]|angolo|angle|ang\.|winkel|vinkel|угол|sudut|kat|uhel|dip|abweichung|avvik|"
        rf"desvio|ecart|отклонение) {_FROM_VERTICAL}|"
        r"(angulo |angle )?(zenith?al(ny|e|en)?|cenital)|zenitov[aey]|hole angle|egiklik|"
        r"duseyden( aci\w*| sapma)?|inklinas(yon|jon)|inklinace|көлбеу(лік)?|"
        r"zenitwinkel|bohrlochneigung|kippung|schwenkwinkel|"
        r"hel+ningsvinkel|hellning|天?顶角|kallistus(kulma)?|kallistuma(kulma)?|경사각?|"
        r"inclinare|naklon\b|nagib\b|sklonu?\b|klison\b|\bdevi\b|"
        r"kipp(achse|winkel)|schwenkachse|\btilt\b|inclinazione|inclinatie|helling|\bodch\b\.?(?!\W*st)|haeldning|hældning|lutning|"
        r"(kat )?odchyleni[ae](?!\W*st)( od pionu)?|(kat )?nachyleni[ae]|ferdeseg|dolesszog|"
        r"egim(?!\w{2})i?|kemiringan( lubang)?|傾斜角?|"
        r"鉛直(線)?からの角度?|"
        r"зен\w*\.?( угол\w*)?|"
        r"neigung(swinkel)?|\bneig\b\.?|\bzenit\b|desviacion|sapma( acisi)?|inklination|inclinaison|inclinaca?o|"
        r"inclinacion|zenith( angle)?|drift angle|deviation angle|(?<![a-z])inkl?\b\.?|"
        r"inklin\b\.?|helning|инклинация|зенит\w*( угол)?|наклон(?!ен)|井斜角?|倾角|顶角|天顶角",
        "inclination ",
    ),
    (_FROM_VERTICAL, ""),
    (r"(?<=inclination) *\((dev(iation)?|desv(io)?)\.?\)", ""),
    (
        r"azimutwinkel|\bmaz(?![^\W\d_])|\bmag[ ._-]*az(?![^\W\d_])|"
        r"\bkurs\b|\bdire(ccion|cao|ction|zione|ctie)\b|\bsemt\b|\bistikamet\b|\byon\b|\barah\b|\bsmer\b|\brumo\b|\bcap\b|\bаз(им)?\b\.?|направление|"
        r"курс|方向角?|磁北からの角度?|"
        r"atsimuutti|suuntakulma|방위각?|\bhazi\b|drehtisch|turn ?table|rotary table|baring|azymut|yonelim|азимут|"
        r"asimut|\basim?\b\.?|azym\b\.?|acim\b\.?|azimutov[aey]|azimute?(?!h(?!oek))|acimut|方位角?|"
        r"rumbo|richting|richtung(?!swinkel)|retning|peilung",
        "azimuth ",
    ),
    (
        r"\bg?tf[oa]\b|tool ?face orientation|relative bearing|\brot\.? angle|toolface[- ]winkel|hochseite(nwinkel)?|"
        r"hoyside(vinkel)?|rolido|(orient\w*\.? (de )?(la )?)?cara alta|orient\b\.? herr(am(ienta)?)?\b\.?|"
        r"(takim|alet) yuzu|takim(?= aci)|yuvarlanma|donme|donus|muka alat|putar(an)?\b|guling\b|fata sculei|ruliu|"
        r"cel[oa] nastroje|pootoceni|rota(zione|ce|tie)\b|rotatie(?=hoek)|\brol(?=hoek)|grav\w*\.? tf\b|"
        r"ауытқытқыш\w*|бұрылу|а[ий]налу|"
        r"alabeo|lado alto|face (da )?ferr(am(enta)?)?\b\.?|rolagem|rolamento|rotacao|"
        r"roulis|rotation propre|orient(ation|\b\.?) (de l')?outil|апсид\w*( угол)?|виз\b\.?( угол)?|(угол )?крена?\b|"
        r"(重力)?高边(工具面)?角?|[滚自旋]转角?|横滚角?|面向角|"
        r"\brol(le?|lio|lo)?\b|kierto(kulma)?\b|natoceni|rotire|vridning|툴페이스|공구면각?|롤각?|\brb\b|\bt/f\b|\btfh\b|rollachse|"
        r"roll axis|(kat )?obrotu?\b|(kat )?skre[tc]\w*|\bуво\b|(угол )?верхней образующей|^面角|"
        r"\brull(e|ing)?\b|rullning|rotasi|(kat )?ustawienia narzedzia|szerszamallas|"
        r"gereedschapsvlak|v(ae|æ)rkt(o|ø)jsflade|faccia utensile|ツールフェ(ー|イ)ス|тулфейс|回転角|угол поворота|"
        r"roll[vw]inkel|roll angle|"
        r"(werkzeug|roll)(winkel|lage|flache)|verdrehung|verdrehwinkel|drehwinkel|rotasjon|rulle?vinkel|"
        r"verktoy(flate|vinkel|side)\w*|(face|angulo) d[ae] ferramenta|(face|angle)( d[e'])? ?(l'?)?outil|"
        r"ghsf?\b|угол установки( отклонител\w*)?|визир\w*( угол)?|"
        r"angulo de giro|giro|вращени[ея]|rotacion|отклонител\w*|откл\b\.?|визирн\w* угол|поворот|工具面角?|"
        r"\bcara\b(?! *mag)( (de (la )?)?(herr(am(ienta)?)?|h(er)?tt?a)\b\.?)?|"
        r"tf grav\w*|gravity tool ?face|h\.?s\.?[ _-]*tool ?face|"
        r"tool[ _-]*face( (d[ae] )?(la )?grav\w*| ?\(grav\w*\.?\))?",
        "toolface ",
    ),
    (
        r"重力(加速度计?|分量|传感器)(?=[ (（_]*[xyz])|重力[计仪]|аксел\w*\.?|\bуск\b\.?|\bграв\b\.?(?=[ _]*[xyz]\b)|"
        r"kiiht\b\.?|kiihtyvyys|zrychl(eni)?\b\.?|가속도계?|acceleratie|acceleratia|akcelerometry?\b|accelero\b\.?|"
        r"przysp(ieszenie)?\b\.?|gyorsulas(mero)?|ivme( olcer|\w*)|versn(elling(smeter)?)?\b\.?|"
        r"accelerazione|үдеу\w*|\baksel\b\.?|"
        r"accelerometro|percepatan|加速度|γ|"
        r"beschleunigung\w*|beschl\b\.?|akselerasjon|akselerometer|akselero|aceleracion|acelerometros?|acel\b|"
        r"aceleracao|accelerometres?|acceleration|\bac\.|ускорен\w*|акселерометр\w*|акс\b|\baks\b|加速度计?|加计|加表",
        "acc ",
    ),
    (
        r"(\bb-?)?\bfel[dt](?=[ _]*[xyz]\b)|magnetsensor|(campo|champ) mag\w*\.?(?=[ _]*[xyz]\b)|"
        r"(\bмаг\w*\.? ?)?\bполе(?=[ _]*[xyz]\b)|\bмаг\b\.?(?=[ _]*[xyz]\b)|"
        r"磁(场强度|传感器|分量|通|力)(?=[ (（_]*[bhm]?[xyz])|"
        r"자기장?(?=[ _]*[xyz])|kentta(?=[ _]*[xyz])|pole(?=[ _]*[xyz])|camp( magn\w*)?(?=[ _]*[xyz])|"
        r"pole magn\w*\.?(?=[ _]*[xyz])|magneses(?=[ _]*[xyz])|manyetik(?=[ _]*[xyz])|magneetveld(?=[ _]*[xyz])|"
        r"\bveld(?=[ _]*[xyz])|indukcja( magn\w*)?(?=[ _]*[xyz])|(магнит\w* )?өріс\w*(?=[ _]*[xyz])|"
        r"medan(?=[ _]*[xyz])|磁気(?=[ _]*[xyz])|magnetfalt(?=[ _]*[xyz])|campo(?=[ _]*[bhm]?[xyz]\b)|"
        r"\bmagneto\b\.?|magnetometre|magn\b\.?(?=[ _]*[xyz]\b)|magnet(feld|felt)(?=[ _]*[bhm]?[xyz]\b)|"
        r"(magnetic|магнитн\w*) (field|поле)(?=[ _]*[bhm]?[xyz]\b)|champ( magn\w*)?(?=[ _]*[bhm]?[xyz]\b)|"
        r"magnetometry|magnetometros?|"
        r"magnetometr(?=[ _]*[xyz])|magnetometers?|магнитометр\w*|магн\b|феррозонд\w*|磁力[计仪]|\bfluks(gate)?\b|"
        r"磁通门|磁强计|campo magnetico(?=[ _]*[bhm]?[xyz]\b)|campo mag(?=[ _]*[xyz])|"
        r"\bmtm\b|磁(?=[ _]*[xyz])|flux[ _-]*gates?|磁场(?=[ (（_]*[bhm]?[xyz])",
        "mag ",
    ),
    (
        r"поле полное|地?磁场总强度|"
        r"kokonaiskentta|celkove pole|전자기장|전자력|camp total|natezenie pola|pole calkow\w*|calkowite pole|"
        r"(teljes )?terero|toplam alan|totaalveld|"
        r"campo totale|medan total|全磁力|"
        r"feldstarke|gesamtfeld|totalfeld|totalfelt|champ( magn\w*)?( total)?|campo (total|local|magn\w*)|"
        r"intensidad total|полн\w* (магн\w* )?(поле|вектор\w*)|"
        r"модуль (магн\w*|поля)|总磁场(强度)?|磁场强度|总场|totalintensitat",
        "total field ",
    ),
    (
        r"중력(가속도)?|painovoima|tihove zrychleni|zwaartekracht|yercekimi|nehezsegi gyorsulas|gravita\b|"
        r"gravitasi\b|tyngdkraft|"
        r"schwere|gravitation|pesanteur|tyngde\w*|gravedad|gravidade|сила тяжести|重力(加速度)?",
        "gravity ",
    ),
    (r"(град\w*\.?|°)\s?[сc](?![а-яa-z])", "degc"),
    (r"^т(?=\W)", "T"),
    (r"м/с\s?(²|\^?2)", "m/s2"),
    (r"(?<![а-я])а/м(?![а-я])", "A/m"),
    (r"(?<![а-я])мэ(?![а-я])", "mG"),
    (r"(?<![а-я])э(?![а-я])", "gauss"),
    (r"нтл", "nT"),
    (r"мктл", "uT"),
    (r"м[gг](?![а-яa-z])", "mg"),
    (r"мгс(?![а-я])", "mG"),
    (r"(?<![а-я])гс(?![а-я])", "gauss"),
    (
        r"(?<![a-zа-я])(градус\w*|град|grados|graus|graden|gradi|grader|grad|derajat|derece|"
        r"stopni?e?|fok)(?![a-zа-я])|(?<!温)度(?=[)）]?$)",
        "deg",
    ),
    (r"код\w* ацп|ацп|отсч\w*|(?<![а-я])код(а|ы|ов)?(?![а-я])|码值|码数|计数值?", "adc"),
    (r"мв(?![а-я])", "mV"),
    (
        r"\bttmp\b|termopar|thermocouple|th?ermoelement|термопара|热电偶|"
        r"lampotila|teplota|درجة الحرارة|θερμοκρασια|온도|nhiet do|"
        r"temp-ra|темп-ра|sicaklik|homerseklet|temperatuur|suhu|pt100(0)?\b|temperatura|"
        r"temperature?n?|температура|темп\b\.?|温度",
        "temperature ",
    ),
    (
        r"sollwerte?|sollwinkel|soll|\b(desejad[oa]|desead[oa]|gewunschte?r?|onske[td]|onskade|zadan[aey]|fixture|stativ(et)?|stol(u|ika)?)\b|"
        r"设定(值|角)?|\brig\b|referenz|referanse|(\b(de|di|do) )?(referencia|riferimento)|"
        r"(\bde )?reference|stand( settings?)?|"
        r"(angulos? )?d[ae] (la )?(mesa|bancada)|^(bancada|mesa|banco)\b|"
        r"\b(du|del|do) banco?\b|эталон\w*|стенд|задан\w*|标准|参考|转台",
        "ref ",
    ),
    (
        r"sarjanumero|vyrobni cislo|일련번호|seriennummer|seriennr|serienummer|заводской номер|序列号|n(um\w*|"
        r"[o°º])?\.? ?[°º]? ?de serie|serie n[°ºr]\.?",
        "serial ",
    ),
    (r"(\bgeogr\w*|географічн\w*)\.?|cografi( kuzey\w*)?", "true "),
    (r"(?<![a-z])[uv] ?(?=[gabhm][xyz]\b)", ""),
    (r"输出(电压|信号|值)?", " output "),
    (r"gerat|sonde", "tool "),
    (r"(de|da) [qc]uadr[ií]cula( utm)?|gitter|kartesisch", "grid "),
    (r"achse|aksen?|eje|ось|轴", ""),
    (
        r"magnetisch\w*|magnetic[oa]s?|magnetique|magnetiska?|magnetycz\w*|manyetik|magneses|магнитн\w*|магниттік|"
        r"magneti(k|ck[aey])\b|magnet\b|"
        r"magn\b\.?",
        "magnetic",
    ),
    (r"\((alta|high ?side|lado alto|hochseite|oben)\)", ""),
    (
        r"\b(ang(ulo|olo|le)?|kat|sudut|unghi(ul)?|uhel)\b\.?( d[aei]\b)? *(?=(inclination|azimuth|toolface|dip|tf)\b)|"
        r"(?<=(?:(?<=on)|(?<=th)|(?<=ce)|(?<=ip)|(?<=tf)) )[ -]*(s?hoek|aci\w*|uhel|ang\.|бұрыш\w*)(?![^\W\d_])",
        "",
    ),
)
"""Words of other languages and of WITSML, and the word of the field for each."""


@lru_cache(maxsize=4096)
def spelled(name: str) -> str:
    """A name in plain letters, with the words of the field.

    >>> spelled("Neigung Soll (°)"), spelled("gravTran1Raw")
    ('inclination ref (°)', 'acc X Raw')
    """
    text = _LOOKALIKE.sub(lambda m: m[0].translate(LATIN_AXES), name)
    text = text.translate(_LATIN).replace("º", "°").replace("°", "\0").replace("²", "\1")
    text = without_marks(text).replace("_", " ")
    text = text.replace("\0", "°").replace("\1", "²")
    text = re.sub(r"(?<![^\W_])([^\W\d_])\.(?=[^\W\d_](?![^\W_]))", r"\1", text)  # T.F.
    for pattern, word in TRANSLATIONS:
        text = re.sub(pattern, word, text, flags=re.IGNORECASE)
    return text.strip()


STATIONS_ELSEWHERE = "точка точки noточки позиция станция 测点 测点号 序号 位置"
"""Names of a column of stations in other alphabets, as `letters` gives them."""


def letters(name: str) -> str:
    """The letters of a name, small and plain.

    >>> letters("Posición"), letters("Nr."), letters("№ точки")
    ('posicion', 'nr', 'noточки')
    """
    text = unicodedata.normalize("NFKD", name.translate(_LATIN)).lower()
    return unicodedata.normalize("NFC", "".join(c for c in text if c.isalpha()))


def translated(column: str) -> frozenset[str]:
    """Words of other languages for what a column of a run file holds."""
    patterns = (
        pattern
        for pattern, word in TRANSLATIONS
        if (m := resembled(word.strip())) and m.column == column
    )
    return frozenset(
        word for pattern in patterns for word in re.findall(r"(?<!\\)[^\W\d_]{5,}", pattern)
    )
