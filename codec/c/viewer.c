/* A viewer with OpenGL 3.3 and GLFW, which renders as described in codec/EMBEDDING.md:
 *
 *     cc -O3 csplat.c viewer.c -lz -lm -lglfw -lGL && ./a.out scene.csplat       drag to turn, scroll to zoom
 *     ./a.out scene.csplat out.ppm 'W H fx fy cx cy near VIEWMAT'                one picture; 12 numbers, row by row
 *
 * It draws level 0. Textures hold the decoder's arrays unchanged. For each picture the CPU sorts the indices of the splats by
 * depth; the vertex shader draws a rectangle around each splat's ellipse and evaluates SH. If the GL library does not export
 * its functions (Windows), a loader is required. SPDX-License-Identifier: Apache-2.0 */
#include "csplat.h"

#define GLFW_INCLUDE_GLCOREARB
#define GL_GLEXT_PROTOTYPES
#include <GLFW/glfw3.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* A pinhole camera: x right, y down, z forward; focal lengths and centre in pixels; scene to camera axes, by rows. */
typedef struct camera {
    int width, height;
    float focal[4], near, view[12];
} camera;

static const csplat_info *info;
static csplat_scene *scene;
static size_t count;                                 /* number of splats */
static uint32_t *order, *keys, *other;               /* [count], for sorting */
static double yaw = 0.5, pitch = -0.3, distance = 0; /* set by the mouse, around `centre` */
static double centre[3];
static GLuint frame; /* render target */

static const char vertex_text[] =
    "#version 330 core\n"
    "layout(location = 0) in uint number;\n"
    "uniform samplerBuffer means, quats, scales, opacities, sh0, shN;\n"
    "uniform mat4x3 view;\n"
    "uniform vec4 focal;\n"
    "uniform vec2 size;\n"
    "uniform int terms;\n" /* SH coefficients above band 0 */
    "uniform bool antialiased, discs;\n"
    "out vec2 d;\n"
    "flat out vec4 colour;\n"
    "flat out vec3 inverse;\n"
    "vec3 three(samplerBuffer from, int i) {\n"
    "    return vec3(texelFetch(from, 3 * i).r, texelFetch(from, 3 * i + 1).r, texelFetch(from, 3 * i + 2).r);\n"
    "}\n"
    "vec3 shine(int i, vec3 v) {\n"
    "    float x = v.x, y = v.y, z = v.z, xx = x * x, yy = y * y, zz = z * z;\n"
    "    float basis[24] = float[24](-0.48860251 * y, 0.48860251 * z, -0.48860251 * x, 1.09254843 * x * y,\n"
    "        -1.09254843 * y * z, 0.31539157 * (2 * zz - xx - yy), -1.09254843 * x * z, 0.54627422 * (xx - yy),\n"
    "        -0.59004359 * y * (3 * xx - yy), 2.89061144 * x * y * z, -0.45704580 * y * (4 * zz - xx - yy),\n"
    "        0.37317633 * z * (2 * zz - 3 * xx - 3 * yy), -0.45704580 * x * (4 * zz - xx - yy),\n"
    "        1.44530572 * z * (xx - yy), -0.59004359 * x * (xx - 3 * yy), 2.50334294 * x * y * (xx - yy),\n"
    "        -1.77013077 * y * z * (3 * xx - yy), 0.94617470 * x * y * (7 * zz - 1), -0.66904654 * y * z * (7 * zz - 3),\n"
    "        0.10578555 * ((35 * zz - 30) * zz + 3), -0.66904654 * x * z * (7 * zz - 3),\n"
    "        0.47308735 * (xx - yy) * (7 * zz - 1), -1.77013077 * x * z * (xx - 3 * yy),\n"
    "        0.62583574 * (xx * xx - 6 * xx * yy + yy * yy));\n"
    "    vec3 sum = 0.5 + 0.28209479 * three(sh0, i);\n"
    "    for (int k = 0; k < terms; k++) sum += basis[k] * three(shN, i * terms + k);\n"
    "    return max(sum, 0);\n"
    "}\n"
    "void main() {\n"
    "    int i = int(number);\n"
    "    vec3 mean = three(means, i), t = view * vec4(mean, 1), s = three(scales, i), width = exp(s);\n"
    "    gl_Position = vec4(2, 2, 2, 1);\n" /* outside the picture */
    "    if (discs) width[s.x <= min(s.y, s.z) ? 0 : s.y <= s.z ? 1 : 2] = 0;\n"
    "    vec4 q = texelFetch(quats, i);\n" /* w x y z in x y z w */
    "    mat3 turn = mat3(1 - 2 * (q.z * q.z + q.w * q.w), 2 * (q.y * q.z + q.x * q.w), 2 * (q.y * q.w - q.x * q.z),\n"
    "                     2 * (q.y * q.z - q.x * q.w), 1 - 2 * (q.y * q.y + q.w * q.w), 2 * (q.z * q.w + q.x * q.y),\n"
    "                     2 * (q.y * q.w + q.x * q.z), 2 * (q.z * q.w - q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z));\n"
    "    vec2 limit = 0.65 * size / focal.xy, p = clamp(t.xy / t.z, -limit, limit);\n"
    "    mat3 root = mat3(view) * turn;\n"
    "    vec3 u = vec3(focal.x, 0, -focal.x * p.x) / t.z * root * width;\n" /* rows of J V R S: their products are */
    "    vec3 v = vec3(0, focal.y, -focal.y * p.y) / t.z * root * width;\n" /* the projected covariance, xx xy yy */
    "    vec3 c = vec3(dot(u, u), dot(u, v), dot(v, v)), wide = c + vec3(0.3, 0, 0.3);\n"
    "    float det = wide.x * wide.z - wide.y * wide.y, opacity = texelFetch(opacities, i).r;\n"
    "    if (antialiased) opacity *= sqrt(max((c.x * c.z - c.y * c.y) / det, 0));\n"
    "    if (opacity < 1.0 / 255) return;\n"
    "    vec3 eye = -view[3] * mat3(view);\n"
    "    colour = vec4(shine(i, normalize(mean - eye)), opacity);\n"
    "    inverse = vec3(wide.z, -wide.y, wide.x) / det;\n"
    "    d = (vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2 - 1) * sqrt(2 * log(255 * opacity) * wide.xz);\n"
    "    vec2 pixel = focal.xy * t.xy / t.z + focal.zw + d;\n"
    "    gl_Position = vec4(2 * pixel.x / size.x - 1, 1 - 2 * pixel.y / size.y, 0, 1);\n"
    "}\n";

static const char fragment_text[] =
    "#version 330 core\n"
    "in vec2 d;\n"
    "flat in vec4 colour;\n"
    "flat in vec3 inverse;\n"
    "out vec4 result;\n"
    "void main() {\n"
    "    float power = inverse.x * d.x * d.x + 2 * inverse.y * d.x * d.y + inverse.z * d.y * d.y;\n"
    "    float alpha = min(0.99, colour.a * exp(-0.5 * power));\n"
    "    if (alpha < 1.0 / 255) discard;\n"
    "    result = vec4(colour.rgb * alpha, alpha);\n"
    "}\n";

static void die(const char *what)
{
    fprintf(stderr, "%s\n", what);
    exit(1);
}

static void *room(size_t bytes)
{
    void *memory = malloc(bytes ? bytes : 1);
    if (!memory)
        die("no memory");
    return memory;
}

/* Decode a file; its data is kept until the program ends. */
static void read_scene(const char *path)
{
    FILE *input = fopen(path, "rb");
    csplat_error error;
    csplat *file;
    size_t size;
    void *data;
    double squares = 0;
    if (!input || fseek(input, 0, SEEK_END))
        die("cannot open the file");
    data = room(size = (size_t)ftell(input));
    rewind(input);
    if (fread(data, 1, size, input) != size)
        die("cannot read the file");
    fclose(input);
    if (csplat_open_memory(&file, data, size, NULL, &error))
        die(error.message);
    if (csplat_decode(file, CSPLAT_SH_DEGREE_MAX, &scene))
        die(csplat_last_error(file)->message);
    info = csplat_get_info(file);
    count = (size_t)scene->splat_count;
    order = room(4 * count);
    keys = room(4 * count);
    other = room(4 * count);
    for (size_t i = 0; i < 3 * count; i++) {
        centre[i % 3] += (double)scene->values.means[i] / (double)count;
        squares += (double)scene->values.means[i] * (double)scene->values.means[i] / (double)count;
    }
    for (int k = 0; k < 3; k++)
        squares -= centre[k] * centre[k];
    distance = 4 * sqrt(fmax(squares, 1e-12));
}

static void add_shader(GLuint program, GLenum kind, const char *text)
{
    GLuint shader = glCreateShader(kind);
    char log[1000] = "";
    GLint good;
    glShaderSource(shader, 1, &text, NULL);
    glCompileShader(shader);
    glGetShaderiv(shader, GL_COMPILE_STATUS, &good);
    glGetShaderInfoLog(shader, sizeof log, NULL, log);
    if (!good)
        die(log);
    glAttachShader(program, shader);
}

static void put_texture(GLuint program, GLuint unit, const char *name, const float *values, size_t floats, GLenum format)
{
    GLuint buffer, texture;
    GLint most;
    glGetIntegerv(GL_MAX_TEXTURE_BUFFER_SIZE, &most);
    if (floats / (format == GL_RGBA32F ? 4 : 1) > (size_t)most)
        die("this GL has no texture for this many values");
    glGenBuffers(1, &buffer);
    glBindBuffer(GL_TEXTURE_BUFFER, buffer);
    glBufferData(GL_TEXTURE_BUFFER, (GLsizeiptr)(floats * sizeof(float)), values, GL_STATIC_DRAW);
    glGenTextures(1, &texture);
    glActiveTexture(GL_TEXTURE0 + unit);
    glBindTexture(GL_TEXTURE_BUFFER, texture);
    glTexBuffer(GL_TEXTURE_BUFFER, format, buffer);
    glUniform1i(glGetUniformLocation(program, name), (GLint)unit);
}

/* Set up everything that does not change between pictures. */
static GLuint set_up(void)
{
    const csplat_floats *v = &scene->values;
    const unsigned terms = (scene->sh_degree + 1) * (scene->sh_degree + 1) - 1;
    GLuint program = glCreateProgram(), vertices, numbers, picture;
    add_shader(program, GL_VERTEX_SHADER, vertex_text);
    add_shader(program, GL_FRAGMENT_SHADER, fragment_text);
    glLinkProgram(program);
    glUseProgram(program);
    put_texture(program, 0, "means", v->means, 3 * count, GL_R32F);
    put_texture(program, 1, "quats", v->quats, 4 * count, GL_RGBA32F);
    put_texture(program, 2, "scales", v->scales, 3 * count, GL_R32F);
    put_texture(program, 3, "opacities", v->opacities, count, GL_R32F);
    put_texture(program, 4, "sh0", v->sh0, 3 * count, GL_R32F);
    put_texture(program, 5, "shN", v->shN, 3 * terms * count, GL_R32F);
    glUniform1i(glGetUniformLocation(program, "terms"), (GLint)terms);
    glUniform1i(glGetUniformLocation(program, "antialiased"), info->antialiased);
    glUniform1i(glGetUniformLocation(program, "discs"), info->flat);
    glGenVertexArrays(1, &vertices);
    glBindVertexArray(vertices);
    glGenBuffers(1, &numbers);
    glBindBuffer(GL_ARRAY_BUFFER, numbers);
    glEnableVertexAttribArray(0);
    glVertexAttribIPointer(0, 1, GL_UNSIGNED_INT, 0, NULL);
    glVertexAttribDivisor(0, 1); /* one index per instance of the rectangle */
    glGenRenderbuffers(1, &picture);
    glBindRenderbuffer(GL_RENDERBUFFER, picture);
    glGenFramebuffers(1, &frame);
    glBindFramebuffer(GL_FRAMEBUFFER, frame);
    glFramebufferRenderbuffer(GL_FRAMEBUFFER, GL_COLOR_ATTACHMENT0, GL_RENDERBUFFER, picture);
    glEnable(GL_BLEND);
    glBlendFunc(GL_ONE, GL_ONE_MINUS_SRC_ALPHA);
    return program;
}

/* Write the indices of the splats in front of the camera, from back to front; return their number. Depths are positive, so
 * their bits sort in the same order: two counting sorts, by the low and by the high 16 bits. */
static size_t sort(const camera *c)
{
    static uint32_t starts[2][65537];
    const float *v = c->view + 8;
    size_t kept = 0;
    memset(starts, 0, sizeof starts);
    for (size_t i = 0; i < count; i++) {
        const float *p = scene->values.means + 3 * i, depth = v[0] * p[0] + v[1] * p[1] + v[2] * p[2] + v[3];
        if (!(depth >= c->near))
            continue;
        memcpy(&keys[i], &depth, 4);
        keys[i] = ~keys[i]; /* farthest first */
        order[kept++] = (uint32_t)i;
        starts[0][(keys[i] & 65535) + 1]++;
        starts[1][(keys[i] >> 16) + 1]++;
    }
    for (int pass = 0; pass < 2; pass++) {
        const uint32_t *from = pass ? other : order;
        uint32_t *to = pass ? order : other;
        for (int k = 0; k < 65536; k++)
            starts[pass][k + 1] += starts[pass][k];
        for (size_t i = 0; i < kept; i++)
            to[starts[pass][keys[from[i]] >> 16 * pass & 65535]++] = from[i];
    }
    return kept;
}

/* Draw to the frame in floats: the rounding errors of 8 bits would add up with every splat. */
static void draw(GLuint program, const camera *c)
{
    const size_t kept = sort(c);
    glRenderbufferStorage(GL_RENDERBUFFER, GL_RGBA32F, c->width, c->height);
    glViewport(0, 0, c->width, c->height);
    glClearColor(0, 0, 0, 1);
    glClear(GL_COLOR_BUFFER_BIT);
    glUniformMatrix4x3fv(glGetUniformLocation(program, "view"), 1, GL_TRUE, c->view);
    glUniform4fv(glGetUniformLocation(program, "focal"), 1, c->focal);
    glUniform2f(glGetUniformLocation(program, "size"), (float)c->width, (float)c->height);
    glBufferData(GL_ARRAY_BUFFER, (GLsizeiptr)(4 * kept), order, GL_STREAM_DRAW);
    glDrawArraysInstanced(GL_TRIANGLE_STRIP, 0, 4, (GLsizei)kept);
}

/* Draw a picture and write it to a file. */
static void shoot(GLuint program, char *words, const char *path)
{
    double x[19];
    camera c;
    unsigned char *pixels;
    FILE *file = fopen(path, "wb");
    for (int i = 0; i < 19; i++)
        x[i] = strtod(words, &words);
    c.width = (int)x[0];
    c.height = (int)x[1];
    c.near = (float)x[6];
    for (int i = 0; i < 4; i++)
        c.focal[i] = (float)x[2 + i];
    for (int i = 0; i < 12; i++)
        c.view[i] = (float)x[7 + i];
    if (!file || c.width < 1 || c.height < 1 || c.width > 8192 || c.height > 8192)
        die("cannot write the picture, or it has no size");
    draw(program, &c);
    pixels = room(3 * (size_t)c.width * (size_t)c.height);
    glPixelStorei(GL_PACK_ALIGNMENT, 1);
    glReadPixels(0, 0, c.width, c.height, GL_RGB, GL_UNSIGNED_BYTE, pixels);
    fprintf(file, "P6\n%d %d\n255\n", c.width, c.height);
    for (int y = c.height; y--;)
        fwrite(pixels + 3 * (size_t)c.width * (size_t)y, 3, (size_t)c.width, file);
    if (fclose(file))
        die("cannot write the picture");
}

/* Return a camera that looks at the centre from the position set by the mouse. */
static camera orbit(int width, int height)
{
    const double sy = sin(yaw), cy = cos(yaw), sp = sin(pitch), cp = cos(pitch);
    const double turn[3][3] = {{cy, 0, -sy}, {-sp * sy, -cp, -sp * cy}, {-cp * sy, sp, -cp * cy}}; /* to right, up, back */
    const char *axes = info->axes[0] ? info->axes : "RDF";
    camera c = {width, height, {(float)height, (float)height, (float)width / 2, (float)height / 2}, 0, {0}};
    c.near = 0.01F * (float)distance;
    for (int row = 0; row < 3; row++) {
        double v[3], shift = row == 2 ? distance : 0;
        for (int i = 0; i < 3; i++) {
            v[i] = 0;
            for (int k = 0; k < 3; k++) /* directions of the scene's +x, +y, +z */
                v[i] += turn[row][k] * ((axes[i] == "RUB"[k]) - (axes[i] == "LDF"[k]));
            c.view[4 * row + i] = (float)v[i];
            shift -= v[i] * centre[i];
        }
        c.view[4 * row + 3] = (float)shift;
    }
    return c;
}

static void on_move(GLFWwindow *window, double x, double y)
{
    static double last[2];
    if (glfwGetMouseButton(window, GLFW_MOUSE_BUTTON_LEFT) == GLFW_PRESS) {
        yaw -= 0.005 * (x - last[0]);
        pitch = fmax(-1.5, fmin(1.5, pitch - 0.005 * (y - last[1])));
    }
    last[0] = x;
    last[1] = y;
}

static void on_scroll(GLFWwindow *window, double x, double y)
{
    (void)window, (void)x;
    distance *= exp(-0.1 * y);
}

int main(int arguments, char **argument)
{
    GLFWwindow *window;
    GLuint program;
    if (arguments != 2 && arguments != 4)
        die("usage: viewer scene.csplat [out.ppm 'W H fx fy cx cy near VIEWMAT']");
    read_scene(argument[1]);
    if (!glfwInit())
        die("no display");
    glfwWindowHint(GLFW_CONTEXT_VERSION_MAJOR, 3);
    glfwWindowHint(GLFW_CONTEXT_VERSION_MINOR, 3);
    glfwWindowHint(GLFW_OPENGL_PROFILE, GLFW_OPENGL_CORE_PROFILE);
    glfwWindowHint(GLFW_OPENGL_FORWARD_COMPAT, GLFW_TRUE);
    glfwWindowHint(GLFW_VISIBLE, arguments == 2);
    if (!(window = glfwCreateWindow(1280, 720, "csplat", NULL, NULL)))
        die("no OpenGL 3.3");
    glfwMakeContextCurrent(window);
    glfwSetCursorPosCallback(window, on_move);
    glfwSetScrollCallback(window, on_scroll);
    program = set_up();
    if (arguments == 4)
        shoot(program, argument[3], argument[2]);
    while (arguments == 2 && !glfwWindowShouldClose(window)) {
        int width, height;
        camera c;
        glfwGetFramebufferSize(window, &width, &height);
        c = orbit(width ? width : 1, height ? height : 1);
        draw(program, &c);
        glBindFramebuffer(GL_DRAW_FRAMEBUFFER, 0);
        glBlitFramebuffer(0, 0, width, height, 0, 0, width, height, GL_COLOR_BUFFER_BIT, GL_NEAREST);
        glBindFramebuffer(GL_DRAW_FRAMEBUFFER, frame);
        glfwSwapBuffers(window);
        glfwWaitEvents();
    }
    glfwTerminate();
    return 0;
}
