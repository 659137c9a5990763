"""Reads the name of a recorded signal: its words, its unit, and the kind of signal that they mean.

The words are those of PLCs, temperature controllers, printers and loggers in English, German, French, Spanish
and Italian. A name is split at punctuation, digits and capitals and written in ASCII (ö becomes oe, é becomes
e), so `TIst`, `T_ist` and `T.Ist` have the same words. A pattern below matches whole words.
"""

import functools
import re
import unicodedata
from typing import NamedTuple


class Name(NamedTuple):
    """The words of a name without its unit, separated by one space; the kind of its unit, "" for none
    ("degC", "K", "degF", "percent", "speed", "electric", "other"); and the unit as written."""

    words: str
    kind: str
    unit: str


def _pattern(words: str) -> re.Pattern[str]:
    """Returns a pattern for any of the words, which are separated by blanks. In a word, _ stands for an
    optional blank, * for any letters."""
    alternatives = "|".join(words.split()).replace("*", r"\w*").replace("_", " ?")
    return re.compile(rf"(?<!\w)(?:{alternatives})(?!\w)")


# ---- units

_UNITS = {
    "degC": r"°\s?c|℃|deg[ _]?c|grad ?c|celsius|c",
    "K": r"°k|kelvin|k",
    "degF": r"°\s?f|deg[ _]?f|fahrenheit|f",
    "percent": r"%|0 ?(?:-|\.\.|to|bis) ?1(?:00)?|pct|percent|per ?cento?|prozent|pour ?cent|por ?ciento",
    "speed": (
        r"rpm|upm|[u1r]/min|min-1|min\^-1|min⁻¹|tr/min|t/mn|rev/min|giri/min|g/min|[cm]?m/s|m?m/min|mm/sec|"
        r"kg/hr?|ft/min|ft/s|in/s|lbs?/hr?|g/s|mpm|g/h|l/h|l/min|m[m³3]*/h|[cm]m[³3]/s|hz"
    ),
    "electric": r"m?a|m?v|k?w|amp|amps|ampere|volt|volts|watt|watts|kva",
    "other": (
        r"m?bar|psi|[mkh]?pa|k?n|nm|k?wh|m?m|cm|kg|g|l|s|sec|ms|min|h|°|deg|rad|%\s?r\.?[hf]\.?|rh|ppm|db|"
        r"[cm]?m[³3²2]|pcs|stk"
    ),
}
_BRACKET = re.compile(r"[\[({<]\s*([^\[\](){}<>]+?)\s*[\])}>]")
# a unit of one letter is in brackets, or is a temperature's after _ or a number
_TAIL = re.compile(
    r"(?:(?:^|[\s_,;./-])(?:in\s+)?|(?<=\d))("
    r"°\s?[ckf]|℃|deg[ _]?[cf]|celsius|kelvin|fahrenheit|pct|percent|prozent|rpm|upm|[u1r]/min|min-1|tr/min|"
    r"m?m/s|m/min|kg/h|bar|psi|mpa|kpa|nm|kwh?|ma|hz|mpm)$|_([ckf])$|(%)$"
)
_INSIDE = (
    ("degC", re.compile(r"°\s?c|℃|celsius|deg_?c(?![a-z])")),
    ("K", re.compile(r"kelvin")),
    ("degF", re.compile(r"°\s?f|fahrenheit|deg_?f(?![a-z])")),
    ("percent", re.compile(r"%(?!\s?r[hf])|percent|prozent|(?<![a-z])pct(?![a-z])")),
)


def unit_kind(unit: str) -> str:
    """Returns the kind of a unit that stands alone, "" for an unknown one."""
    unit = unit.strip().casefold()
    return next((kind for kind, pattern in _UNITS.items() if re.fullmatch(pattern, unit)), "")


def _unit(name: str) -> tuple[str, str, str]:
    """Returns (name without its unit, kind, unit as written)."""
    for bracket in reversed(list(_BRACKET.finditer(name))):
        if not bracket[1].isdigit() and (kind := unit_kind(bracket[1])):
            return name[: bracket.start()] + " " + name[bracket.end() :], kind, bracket[1]
    lower = name.casefold()
    if (tail := _TAIL.search(lower)) and len(lower) == len(name):
        unit = next(filter(None, tail.groups()))
        return name[: tail.start()], unit_kind(unit), unit
    for kind, pattern in _INSIDE:
        if (inside := pattern.search(lower)) and len(lower) == len(name):
            return name[: inside.start()] + " " + name[inside.end() :], kind, inside[0]
    return name, "", ""


# ---- words

_TOKEN = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|%|[^\W\d_a-zA-Z]+")
_LETTERS = str.maketrans(
    {"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss", "@": " duty "}
)


@functools.lru_cache(maxsize=4096)
def read_name(name: str, unit: str = "") -> Name:
    """Returns the words and the unit of a name. `unit`: the one that the file gives with it, "" for none."""
    bare, kind, written = _unit(name.strip())
    if unit:
        kind, written = unit_kind(unit) or "other", unit
    return Name(split(bare), kind, written)


def split(name: str) -> str:
    """Returns the words of a name in lower-case ASCII, separated by one space."""
    if not name.isascii():
        name = unicodedata.normalize("NFC", name)
    name = name.translate(_LETTERS)
    if not name.isascii():
        name = "".join(c for c in unicodedata.normalize("NFKD", name) if not unicodedata.combining(c))
    return " ".join(_TOKEN.findall(name)).casefold()


# what is wanted
SET_POINT = _pattern(
    "[wtlcs]?sp spt sv setp setpt set_point* setpoint* set_val* set_temp* tempset set soll soll[wtdvsg]* "
    "*soll *sollwert* vorgabe* *vorgabe fuehrungsgr* target* tgt *target ref reference* desired wanted "
    "requested preset consign* csg cons deseado* deseada* objetivo objectif impost* obiettivo riferimento "
    "nominal* gewenst* ingesteld* zadan* tset"
)
# the measured value
ACTUAL = _pattern(
    "ist istw* *istwert* isttemp* istdreh* istleist* [tn]ist tempist actual* act tempact zoneact pv cpv "
    "process_val* measur* meas mess* gemess* mesur* medid* medicion misur* reale? actuel* attual* actueel "
    "reading current_val* current_temp* akt aktuell* rueckm* feedback fbk tact tmeas"
)
# a controller's output: words that mean only this, and words that can also mean a place
DUTY = _pattern(
    "stell* *stellgr* *stellwert* lmn op cv mv duty *pwm* power pwr *leistung* puiss* potenz* potenc* pot "
    "einschaltd* tastgrad tastverh* aussteuer* manipulat* wop ssr moc vermogen heat_out* out_heat "
    "cool_out* output_heat output_cool active_out working_out* control_out* y_out pid_out* ctrl_out* % co "
    "pout ansteuer*"
)
OUTPUT = _pattern("out output* outp uscita salida sortie *ausg* uitgang saida commande")
COMMAND = _pattern("cmd command* comando demand* request*")
HEATER = _pattern(
    "heat* *heater* heiz* *heizung* *heizzone* htr hz chauff* calef* calent* riscald* resist* collier "
    "fascia verwarm* grzal* aquec* hotbed"
)
COOLER = _pattern("*cool* chill* *kuehl* refroid* refrig* enfri* raffred* exchang*")
TEMPERATURE = _pattern(
    "temp temps temper* *temperat* *temp tempist tempsoll tmp thermo* tc tk pt100 pt_100 pt_1000 rtd "
    "*fuehler sond[ea] t ti[ctr]? te tt trc celsius kelvin fahrenheit thermistor tset tact tmeas tamb "
    "tbed tnozzle thotend tzone"
)
# where a machine is heated
PLACE = _pattern(
    "zone* zona* zon *zone* barrel* zylinder* zyl cylind* cilindr* nozzle* *duese* buse boquilla ugello "
    "die werkzeug* filiere filiera matriz adapt* flansch* flange bed *bett cama piatto plateau hot_end* "
    "tool chamber* *kammer mou?ld moule molde stampo manifold hot_runner heisskanal melt z"
)
# speed and flow: words for the quantity, and words for devices that may also have heaters
SPEED = _pattern(
    "drehz* *drehzahl* speed* *speed rpm upm umdreh* giri vitesse* velocid* velocit* vel *geschw* snelh* "
    "toerent* regime fan fans *fan *luefter* *geblaese* ventilat* ventilad* ventol* blower *durchsatz* "
    "throughput debit caudal portata flow *flow feed_rate feedrate avance *vorschub* obrot* sic fic u_min "
    "tr_min line_speed n nist nsoll *rate kgph"
)
MOVER = _pattern(
    "screw* *schneck* vis husillo* tornillo vite motor* *motor moteur* motore *antrieb* drive feed* "
    "*filament* *foerder* *dosier* dosi* dosag* dosif* aliment* puller haul* *abzug* traction traino tiro "
    "*pump* pomp* bomba spindle spindel valve* ventil* vanne* valvula* valvola* agit* mixer vfd* freq* "
    "*umrichter inverter plunger* piston* kolben* hopper"
)
# temperatures that are not controlled: of the surroundings, and of devices
ROOM = _pattern(
    "room* *raum* umgeb* ambi* amb hallen* aussen* outdoor outside exter* estern* sala stanza habitacion "
    "omgeving environment* env enclosure werkstatt workshop coolant *wasser* water* eau agua acqua air "
    "luft* umg tamb traum atelier taller salle officina lab labor laborator*"
)
DEVICE = _pattern(
    "mcu* cpu host *board* raspberry* rpi pi driver* stepper* cold_junction cjc cj vergleich* "
    "reference_junction intern* klemm* terminal* cabinet *schrank* armoire cuadro quadro gear* *getriebe* "
    "*motor* moteur* oil *oel huile aceite olio *lager bearing* inverter *umrichter* psu battery hydrau* "
    "dew* taupunkt*"
)
# limits, settings, modes, counts; and quantities that no temperature model uses
SETTING = _pattern(
    "*alarm* allarm* limit* *grenz* lim hihi lolo max* min maximum minimum kp ki kd tn tv xp gain "
    "*regelabw* deviation *abweich* ecart scarto desviacion error* fehler* auto* manu* mode modo "
    "*betriebsart* hand freigabe enable* schuss* shot* *zyklus* cycle_time cycles *zaehler* count* total* "
    "*zeit laufzeit *dauer tempo tiempo hysteres* offset tolerance *tolerant* gesamt* cos_phi hlm llm"
)
QUANTITY = _pattern(
    "*druck* press* *pressure* pression* presion* pic pi energ* kwh *feucht* *humid* rh umidita humedad "
    "*fuellst* niveau* nivel livello level position* pos *weg *hub stroke layer* progress* gewicht weight "
    "peso poids *torque* *moment* couple coppia *last *load* charge carga carico *auslast* vibra* visco* "
    "dichte density laenge length breite width durchmesser diamet* dicke thickness kraft* *kraft force "
    "override* factor complet* fortschritt* avancement progres* ausschuss verfuegbar* effic* wirkungsgrad "
    "usage ram memory memavail disk rssi sysload oee"
)
ELECTRIC = _pattern("*current *strom ampere* amps courant corrent* corriente volt* *spannung* tension*")


def says(pattern: re.Pattern[str], words: str) -> bool:
    """Returns whether the words of a name contain one of the pattern's."""
    return pattern.search(words) is not None


def any_of(*patterns: re.Pattern[str]) -> re.Pattern[str]:
    """Returns a pattern for the words of all these patterns."""
    return re.compile("|".join(pattern.pattern for pattern in patterns))


def loop_letter(words: str) -> str:
    """Returns the measured variable of a loop's tag (ISA 5.1): "t" of TIC 101, "s" of ST 201; "" without a
    tag."""
    tag = re.search(r"(?<!\w)([a-z])(?:t|e|i|ic|c|ir|rc|it|y) (?!1000?(?!\d))\d{2,}", words)
    return tag[1] if tag else ""
