/* The law over many ticks, for timing: a shared library called through ctypes. */
#include "law_tick.h"

/* inputs[ticks][4]: position, desired position, velocity, acceleration; torque_Nm[ticks] is written. */
void run_ticks(const struct law *k, struct law_state *s, const double *inputs, double *torque_Nm, long ticks)
{
    for (long i = 0; i < ticks; i++)
        torque_Nm[i] = law_tick(k, s, inputs[4 * i], inputs[4 * i + 1], inputs[4 * i + 2], inputs[4 * i + 3]);
}

/* The 15 exponentials of the network alone: where the time of a tick goes. */
void run_hidden(const struct law *k, struct law_state *s, const double *inputs, double *torque_Nm, long ticks)
{
    for (long i = 0; i < ticks; i++)
        torque_Nm[i] = network_torque_Nm(k, s, inputs[4 * i] - inputs[4 * i + 1], inputs[4 * i + 2]);
}

long law_doubles(void) { return sizeof(struct law) / sizeof(double); }
long state_doubles(void) { return sizeof(struct law_state) / sizeof(double); }
