/*
 * Corrects readings by the calibration in mwdcal_fixed.h, which alone differs from tool to tool.
 * C99, whole numbers: no floating point, no library.
 */
#define MWDCAL_FIXED_COEFFICIENTS
#include "mwdcal_fixed.h"

#define ONE INT64_C(1)
#define LARGEST ((ONE << (MWDCAL_FIXED_BITS - 1)) - 1)
#define GUARD 24 /* bits below those of a word while vectors are turned */
#define TURN (ONE << 56)
#define STEPS (MWDCAL_FIXED_BITS + 6)
#define SHRINK INT64_C(2608131496) /* 2^32 over the growth of a vector that is turned in steps */

/* Angles of the tangents 1, 1/2, 1/4 and so on, in 2^-56 turns. */
static const int64_t STEP_ANGLES[] = {
    INT64_C(9007199254740992), INT64_C(5317260203651848), INT64_C(2809494260081566), INT64_C(1426143154396570),
    INT64_C(715839029270683), INT64_C(358268477703266), INT64_C(179177955010598), INT64_C(89594445026371),
    INT64_C(44797906047171), INT64_C(22399038468267), INT64_C(11199529914810), INT64_C(5599766292493),
    INT64_C(2799883313132), INT64_C(1399941677427), INT64_C(699970841321), INT64_C(349985420986),
    INT64_C(174992710534), INT64_C(87496355272), INT64_C(43748177637), INT64_C(21874088818),
    INT64_C(10937044409), INT64_C(5468522205), INT64_C(2734261102), INT64_C(1367130551),
    INT64_C(683565276), INT64_C(341782638), INT64_C(170891319), INT64_C(85445659),
    INT64_C(42722830), INT64_C(21361415), INT64_C(10680707), INT64_C(5340354),
    INT64_C(2670177), INT64_C(1335088), INT64_C(667544), INT64_C(333772),
    INT64_C(166886), INT64_C(83443)};

static int64_t clamped(int64_t value, int64_t low, int64_t high)
{
    return value < low ? low : value > high ? high : value;
}

static int64_t saturated(int64_t value, unsigned *status)
{
    int64_t kept = clamped(value, -LARGEST, LARGEST);
    if (kept != value)
        *status |= MWDCAL_SATURATED;
    return kept;
}

static int64_t plus(int64_t a, int64_t b)
{
    if (a > 0 && b > INT64_MAX - a)
        return INT64_MAX;
    if (a < 0 && b < -INT64_MAX - a)
        return -INT64_MAX;
    return a + b;
}

/* A quotient to the nearest whole number; the divisor is positive. */
static int64_t rounded(int64_t value, int64_t divisor)
{
    int64_t quotient = value / divisor, rest = value % divisor;
    if (rest >= divisor - rest)
        return quotient + 1;
    return -rest >= divisor + rest ? quotient - 1 : quotient;
}

static int64_t course(const mwdcal_word powers[MWDCAL_FIXED_ORDER + 1], int64_t tau)
{
    int64_t value = powers[MWDCAL_FIXED_ORDER];
    int k;
    for (k = MWDCAL_FIXED_ORDER - 1; k >= 0; k--)
        value = clamped(powers[k] + rounded(value * tau, ONE << MWDCAL_FIXED_TAU), -LARGEST, LARGEST);
    return value;
}

static void correct(
    const mwdcal_fixed_triad *triad, const mwdcal_word raw[3], int64_t tau, int64_t field[3], unsigned *status)
{
    int64_t z[3];
    int i, j;
    for (j = 0; j < 3; j++) {
        z[j] = saturated(raw[j], status);
        if (triad->factors) {
            int64_t share = rounded(z[j] * (ONE << triad->quotient), course(triad->scale[j], tau));
            z[j] = saturated(share - course(triad->bias[j], tau), status);
        }
    }
    for (i = 0; i < 3; i++) {
        int64_t sum = course(triad->offset[i], tau) * (ONE << triad->lift);
        for (j = 0; j < 3; j++)
            sum = plus(sum, course(triad->gain[i][j], tau) * z[j]);
        field[i] = saturated(rounded(sum, ONE << triad->sum), status);
    }
}

/* A value over a power of two, rounded down. */
static int64_t shifted(int64_t value, int power)
{
    return value < 0 ? ~(~value >> power) : value >> power;
}

static int64_t shrunk(int64_t value)
{
    int64_t high = shifted(value, 32), low = value - high * (ONE << 32);
    return high * SHRINK + (int64_t)(((uint64_t)low * (uint64_t)SHRINK) >> 32);
}

/* Turns (p[0], p[1]) until p[1] is 0, and q with it; the angle in 2^-56 turns, 0 to 1 turn. */
static int64_t turned(int64_t p[2], int64_t q[2])
{
    int64_t angle = 0;
    int i;
    if (p[0] < 0) {
        p[0] = -p[0], p[1] = -p[1], q[0] = -q[0], q[1] = -q[1];
        angle = TURN / 2;
    }
    for (i = 0; i < STEPS; i++) {
        int64_t sign = p[1] > 0 ? 1 : -1;
        int64_t p0 = p[0] + sign * shifted(p[1], i), q0 = q[0] + sign * shifted(q[1], i);
        p[1] -= sign * shifted(p[0], i), q[1] -= sign * shifted(q[0], i);
        p[0] = p0, q[0] = q0;
        angle += sign * STEP_ANGLES[i];
    }
    p[0] = shrunk(p[0]), q[0] = shrunk(q[0]), q[1] = shrunk(q[1]);
    return angle < 0 ? angle + TURN : angle;
}

static mwdcal_angle angle_word(int64_t angle)
{
    int64_t word = rounded(angle, ONE << (56 - MWDCAL_FIXED_BITS));
    return (mwdcal_angle)(word & ((ONE << MWDCAL_FIXED_BITS) - 1));
}

/*
 * Turns about the tool axis until gravity lies in one plane with it, then until the axis is vertical: what is
 * left of the field points north.
 */
static unsigned angles(int64_t g[3], int64_t b[3], mwdcal_fixed_result *result)
{
    int64_t across[2], level[2], down[2], north[2], magnetic[2], nothing[2] = {0, 0};
    int64_t weak_gravity = (int64_t)MWDCAL_FIXED_WEAK_GRAVITY * (ONE << GUARD);
    int64_t weak_field = (int64_t)MWDCAL_FIXED_WEAK_FIELD * (ONE << GUARD);
    int64_t toolface, inclination, azimuth, magnetic_toolface;
    unsigned status = 0u;
    int i;
    for (i = 0; i < 3; i++)
        g[i] *= ONE << GUARD, b[i] *= ONE << GUARD;
    across[0] = -g[1], across[1] = -g[0], level[0] = -b[1], level[1] = -b[0];
    magnetic[0] = b[1], magnetic[1] = b[0];
    toolface = turned(across, level);
    magnetic_toolface = turned(magnetic, nothing);
    down[0] = g[2], down[1] = across[0], north[0] = b[2], north[1] = level[0];
    inclination = turned(down, north);
    if (inclination > TURN / 2)
        inclination = inclination > TURN / 4 * 3 ? 0 : TURN / 2;
    north[0] = -north[1], north[1] = -level[1];
    azimuth = turned(north, nothing);
    if (down[0] < weak_gravity)
        status |= MWDCAL_NO_GRAVITY;
    else if (across[0] < weak_gravity)
        status |= MWDCAL_VERTICAL;
    else if (north[0] < weak_field)
        status |= MWDCAL_NO_NORTH;
    if (magnetic[0] < weak_field)
        status |= MWDCAL_AXIAL_FIELD;
    result->inclination = status & MWDCAL_NO_GRAVITY ? 0 : angle_word(inclination);
    result->toolface = status & (MWDCAL_NO_GRAVITY | MWDCAL_VERTICAL) ? 0 : angle_word(toolface);
    result->azimuth = status & (MWDCAL_NO_GRAVITY | MWDCAL_VERTICAL | MWDCAL_NO_NORTH) ? 0 : angle_word(azimuth);
    result->magnetic_toolface = status & MWDCAL_AXIAL_FIELD ? 0 : angle_word(magnetic_toolface);
    return status;
}

unsigned mwdcal_fixed(
    const mwdcal_word a[3], const mwdcal_word m[3], mwdcal_word temperature, mwdcal_fixed_result *result)
{
    const mwdcal_word *raw[2];
    int64_t vectors[2][3] = {{0, 0, 0}, {0, 0, 0}};
    int64_t inside = clamped(temperature, MWDCAL_FIXED_LOWEST, MWDCAL_FIXED_HIGHEST);
    unsigned status = inside == temperature ? 0u : MWDCAL_OUTSIDE_TEMPERATURE;
    int t, i;
    raw[0] = a;
    raw[1] = m;
    for (t = 0; t < MWDCAL_FIXED_TRIADS; t++)
        correct(&TRIADS[t], raw[t], inside - MWDCAL_FIXED_REFERENCE, vectors[t], &status);
    for (i = 0; i < 3; i++) {
        result->gravity[i] = (mwdcal_word)vectors[0][i];
        result->field[i] = (mwdcal_word)vectors[1][i];
    }
    return status | angles(vectors[0], vectors[1], result);
}
