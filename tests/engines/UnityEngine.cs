// As much of UnityEngine as the package uses, so that Mono compiles and runs it: by Unity's documentation, left-handed.

using System;

namespace UnityEngine
{
    public struct Vector3
    {
        public float x, y, z;

        public Vector3(float x, float y, float z)
        {
            this.x = x;
            this.y = y;
            this.z = z;
        }

        public static Vector3 operator +(Vector3 a, Vector3 b) => new Vector3(a.x + b.x, a.y + b.y, a.z + b.z);

        public static Vector3 operator -(Vector3 a, Vector3 b) => new Vector3(a.x - b.x, a.y - b.y, a.z - b.z);

        public static Vector3 operator *(Vector3 a, float scale) => new Vector3(a.x * scale, a.y * scale, a.z * scale);
    }

    public struct Quaternion
    {
        public float x, y, z, w;

        public Quaternion(float x, float y, float z, float w)
        {
            this.x = x;
            this.y = y;
            this.z = z;
            this.w = w;
        }

        public static readonly Quaternion identity = new Quaternion(0, 0, 0, 1);

        public static Quaternion Euler(float x, float y, float z) => identity; // of the sample, which is compiled alone

        public static Quaternion Inverse(Quaternion q) => new Quaternion(-q.x, -q.y, -q.z, q.w);

        public static Quaternion operator *(Quaternion a, Quaternion b) => new Quaternion(
            a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
            a.w * b.y + a.y * b.w + a.z * b.x - a.x * b.z,
            a.w * b.z + a.z * b.w + a.x * b.y - a.y * b.x,
            a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z);

        public static Vector3 operator *(Quaternion q, Vector3 v)
        {
            var turned = q * new Quaternion(v.x, v.y, v.z, 0) * Inverse(q);
            return new Vector3(turned.x, turned.y, turned.z);
        }
    }

    public class Object
    {
        public string name = "";
        public bool isDestroyed;

        public static void Destroy(Object one)
        {
            one.isDestroyed = true;
        }
    }

    public class Transform : Object
    {
        public Vector3 position, localScale = new Vector3(1, 1, 1);
        public Quaternion rotation = Quaternion.identity;

        public Vector3 InverseTransformPoint(Vector3 point) => Quaternion.Inverse(rotation) * (point - position) * (1 / localScale.x);
    }

    public class Component : Object
    {
        public Transform transform { get; } = new Transform();
    }

    public class MonoBehaviour : Component
    {
    }

    public enum TextureFormat
    {
        RGBA32 = 4,
    }

    public class Texture2D : Object
    {
        public readonly int width, height;
        public uint[] shown = new uint[0]; // by Apply
        uint[] data;

        public Texture2D(int width, int height, TextureFormat format, bool mipChain)
        {
            this.width = width;
            this.height = height;
            data = new uint[width * height];
            shown = new uint[width * height];
        }

        public void SetPixelData<T>(T[] values, int mipLevel, int sourceDataStartIndex = 0)
        {
            Array.Copy(values, sourceDataStartIndex, data, 0, data.Length);
        }

        public void Apply(bool updateMipmaps)
        {
            Array.Copy(data, shown, data.Length);
        }
    }

    public static class Application
    {
        public static string streamingAssetsPath => Environment.GetEnvironmentVariable("STREAMING_ASSETS") ?? "";
    }

    public sealed class TooltipAttribute : Attribute
    {
        public TooltipAttribute(string tooltip)
        {
        }
    }

    public sealed class AddComponentMenu : Attribute
    {
        public AddComponentMenu(string menuName)
        {
        }
    }

    // What the sample needs beside, to be compiled alone:

    public enum PrimitiveType
    {
        Quad,
        Cube,
    }

    public class GameObject : Component
    {
        public static GameObject CreatePrimitive(PrimitiveType type) => new GameObject();

        public T AddComponent<T>() where T : Component, new() => new T();

        public T GetComponent<T>() where T : Component, new() => new T();
    }

    public class Shader : Object
    {
        public static Shader Find(string name) => new Shader();
    }

    public class Material : Object
    {
        public Texture2D mainTexture;

        public Material(Shader shader)
        {
        }
    }

    public class Renderer : Component
    {
        public Material material;
    }

    public static class Input
    {
        public static float GetAxis(string axisName) => 0;
    }

    public static class Time
    {
        public static float deltaTime => 0;
    }

    public struct Rect
    {
        public Rect(float x, float y, float width, float height)
        {
        }
    }

    public static class GUI
    {
        public static void Label(Rect position, string text)
        {
        }
    }
}
