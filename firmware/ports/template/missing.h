/* Marks a function that is still to be written: the link fails, and the build names the function. */
#ifndef VIBROCAST_TEMPLATE_MISSING_H
#define VIBROCAST_TEMPLATE_MISSING_H

/* There is no function vc_missing_NAME. */
#define VC_MISSING(name)                                                                                               \
    do {                                                                                                               \
        extern void vc_missing_##name(void);                                                                           \
        vc_missing_##name();                                                                                           \
    } while (0)

#endif
