/* Torques of a tree of joints by recursive Newton-Euler, as firmware_py/arm_model.py computes them.
 *
 * Written to be compared with it: same frames, same records.  Every field is a double, so that numpy can fill the
 * structures as flat arrays (tests/bench/c_programs.py has the same order).
 */
#ifndef ARM_MODEL_H
#define ARM_MODEL_H

#include <math.h>

#define MOST_LINKS 16

struct link { /* parent -1: the base; kind 0: revolute, 1: prismatic */
    double parent, kind, rotation[3][3], offset[3], mass, moment[3], inertia[6], motor_inertia;
};

struct motion {
    double position, velocity, acceleration, torque;
    double turn[3][3], place[3], spin[3], spin_up[3], pull[3], force[3], moment[3];
};

static inline void add_cross(double *out, const double *a, const double *b)
{
    out[0] += a[1] * b[2] - a[2] * b[1];
    out[1] += a[2] * b[0] - a[0] * b[2];
    out[2] += a[0] * b[1] - a[1] * b[0];
}

/* a + w' x p + w x (w x p) */
static inline void add_turning(double *out, const double *spin, const double *spin_up, const double *place)
{
    double around[3] = {0.0, 0.0, 0.0};
    add_cross(around, spin, place);
    add_cross(out, spin_up, place);
    add_cross(out, spin, around);
}

static inline void into(double *out, double turn[3][3], const double *v) /* from the parent's frame into the own one */
{
    for (int k = 0; k < 3; k++)
        out[k] = turn[0][k] * v[0] + turn[1][k] * v[1] + turn[2][k] * v[2];
}

static inline void out_of(double *out, double turn[3][3], const double *v)
{
    for (int k = 0; k < 3; k++)
        out[k] = turn[k][0] * v[0] + turn[k][1] * v[1] + turn[k][2] * v[2];
}

static inline void go_out(const struct link *link, struct motion *own, const struct motion *parent)
{
    int slides = link->kind != 0.0;
    double c = slides ? 1.0 : cos(own->position), s = slides ? 0.0 : sin(own->position);
    double shift = slides ? own->position : 0.0, speed = slides ? own->velocity : 0.0;
    double spin = slides ? 0.0 : own->velocity;
    for (int k = 0; k < 3; k++) {
        const double *fixed = link->rotation[k];
        own->turn[k][0] = fixed[0] * c + fixed[1] * s;
        own->turn[k][1] = fixed[1] * c - fixed[0] * s;
        own->turn[k][2] = fixed[2];
        own->place[k] = link->offset[k] + shift * fixed[2];
    }
    double pull[3] = {parent->pull[0], parent->pull[1], parent->pull[2]};
    add_turning(pull, parent->spin, parent->spin_up, own->place);
    into(own->spin, own->turn, parent->spin);
    into(own->spin_up, own->turn, parent->spin_up);
    into(own->pull, own->turn, pull);
    own->spin_up[0] += own->spin[1] * spin;
    own->spin_up[1] -= own->spin[0] * spin;
    own->spin_up[2] += slides ? 0.0 : own->acceleration;
    own->pull[0] += 2.0 * own->spin[1] * speed;
    own->pull[1] -= 2.0 * own->spin[0] * speed;
    own->pull[2] += slides ? own->acceleration : 0.0;
    own->spin[2] += spin;
    const double *i = link->inertia, *w = own->spin, *u = own->spin_up;
    double turning[3] = {i[0] * w[0] + i[1] * w[1] + i[2] * w[2], i[1] * w[0] + i[3] * w[1] + i[4] * w[2],
                         i[2] * w[0] + i[4] * w[1] + i[5] * w[2]};
    for (int k = 0; k < 3; k++)
        own->force[k] = link->mass * own->pull[k];
    add_turning(own->force, w, u, link->moment);
    own->moment[0] = i[0] * u[0] + i[1] * u[1] + i[2] * u[2];
    own->moment[1] = i[1] * u[0] + i[3] * u[1] + i[4] * u[2];
    own->moment[2] = i[2] * u[0] + i[4] * u[1] + i[5] * u[2];
    add_cross(own->moment, w, turning);
    add_cross(own->moment, link->moment, own->pull);
}

static inline void come_back(const struct link *link, struct motion *own, struct motion *parent)
{
    own->torque = (link->kind == 0.0 ? own->moment[2] : own->force[2]) + link->motor_inertia * own->acceleration;
    double force[3], moment[3];
    out_of(force, own->turn, own->force);
    out_of(moment, own->turn, own->moment);
    add_cross(moment, own->place, force);
    for (int k = 0; k < 3; k++) {
        parent->force[k] += force[k];
        parent->moment[k] += moment[k];
    }
}

/* motion has one element more than links: the base, whose pull is that of gravity, negative. */
static inline void newton_euler(const struct link *links, struct motion *motion, int count)
{
    struct motion *base = &motion[count];
    for (int i = 0; i < count; i++)
        go_out(&links[i], &motion[i], links[i].parent < 0.0 ? base : &motion[(int)links[i].parent]);
    for (int i = count - 1; i >= 0; i--)
        come_back(&links[i], &motion[i], links[i].parent < 0.0 ? base : &motion[(int)links[i].parent]);
}

#endif
