// A Unity client of `morph live --stream ws` (docs/streams.md): one object's mesh, moved and coloured as frames come.
//
// Put it on a GameObject with a MeshFilter and a MeshRenderer whose material shows vertex colours, below the camera of
// the scene, and paste the address that morph printed. It needs the package com.unity.nuget.newtonsoft-json.

using System;
using System.Collections.Concurrent;
using System.Collections.Generic;
using System.IO;
using System.Net.WebSockets;
using System.Text;
using System.Threading;
using System.Threading.Tasks;
using Newtonsoft.Json.Linq;
using UnityEngine;

public class MorphStream : MonoBehaviour
{
    public string address = "http://127.0.0.1:8767/?token=...";
    public string objectName = "";  // empty: the first object

    readonly ConcurrentQueue<byte[]> received = new ConcurrentQueue<byte[]>();
    readonly CancellationTokenSource stop = new CancellationTokenSource();
    Mesh mesh;
    JObject known;
    Color32[] colours;

    void Start()
    {
        mesh = new Mesh { indexFormat = UnityEngine.Rendering.IndexFormat.UInt32 };
        mesh.MarkDynamic();
        GetComponent<MeshFilter>().mesh = mesh;
        Task.Run(Receive);
    }

    void OnDestroy() => stop.Cancel();

    async Task Receive()
    {
        var page = new Uri(address);
        using (var socket = new ClientWebSocket())
        {
            await socket.ConnectAsync(new Uri($"ws://{page.Authority}/stream{page.Query}"), stop.Token);
            var buffer = new ArraySegment<byte>(new byte[1 << 16]);
            while (socket.State == WebSocketState.Open)
            {
                var message = new MemoryStream();
                WebSocketReceiveResult part;
                do
                {
                    part = await socket.ReceiveAsync(buffer, stop.Token);
                    message.Write(buffer.Array, 0, part.Count);
                } while (!part.EndOfMessage);
                if (part.MessageType == WebSocketMessageType.Binary) received.Enqueue(message.ToArray());
            }
        }
    }

    void Update()
    {
        while (received.TryDequeue(out var data)) Show(data);
    }

    void Show(byte[] data)
    {
        int length = BitConverter.ToInt32(data, 0), offset = 4 + length;
        var head = JObject.Parse(Encoding.UTF8.GetString(data, 4, length));
        var arrays = new Dictionary<string, Array>();
        foreach (var listed in head["arrays"])
        {
            int size = (int)listed[2];
            Array values = (string)listed[1] == "<f4" ? (Array)new float[size] : new int[size];
            Buffer.BlockCopy(data, offset, values, 0, 4 * size);
            arrays[(string)listed[0]] = values;
            offset += 4 * size;
        }
        if ((string)head["type"] == "scene") ShowScene(head, arrays);
        else if ((string)head["type"] == "frame" && known != null) ShowFrame(head, arrays);
    }

    void ShowScene(JObject head, Dictionary<string, Array> arrays)
    {
        known = Find(head["objects"], objectName);
        objectName = (string)known["name"];
        var map = (JArray)head["colours"];
        colours = new Color32[map.Count];
        for (int i = 0; i < map.Count; i++)
            colours[i] = new Color32((byte)map[i][0], (byte)map[i][1], (byte)map[i][2], 255);
        mesh.Clear();
        mesh.vertices = Points((float[])arrays[objectName + "/rest"]);
        // Outside is where corners run clockwise in Unity, and anticlockwise in a stream.
        var triangles = (int[])arrays[objectName + "/triangles"];
        for (int i = 0; i < triangles.Length; i += 3) Array.Reverse(triangles, i, 3);
        mesh.triangles = triangles;
    }

    void ShowFrame(JObject head, Dictionary<string, Array> arrays)
    {
        var state = Find(head["objects"], objectName);
        if (state["camera_from_object"] is JArray pose) Place(pose);
        if (!arrays.TryGetValue(objectName + "/vertices", out var vertices)) return;  // the last shape stays
        mesh.vertices = Points((float[])vertices);
        if (arrays.TryGetValue(objectName + "/scalar", out var scalar))
            mesh.colors32 = Colours((float[])scalar, (float)known["scalar"]["low"], (float)known["scalar"]["high"]);
        mesh.RecalculateNormals();
        mesh.RecalculateBounds();
    }

    static JObject Find(JToken objects, string name)
    {
        foreach (JObject one in objects)
            if (name == "" || (string)one["name"] == name) return one;
        throw new ArgumentException($"the stream has no object '{name}'");
    }

    // y points down in the camera frame and up in Unity. The mesh is mirrored like this as well, so that the rotation
    // between both is F R F with F = diag(1, -1, 1).
    static Vector3[] Points(float[] values)
    {
        var points = new Vector3[values.Length / 3];
        for (int i = 0; i < points.Length; i++)
            points[i] = new Vector3(values[3 * i], -values[3 * i + 1], values[3 * i + 2]);
        return points;
    }

    void Place(JArray pose)
    {
        transform.localPosition = Column(pose, 3);
        transform.localRotation = Quaternion.LookRotation(Column(pose, 2), Column(pose, 1));
    }

    static Vector3 Column(JArray pose, int column)
    {
        float sign = column == 1 ? -1 : 1;
        return new Vector3(
            sign * (float)pose[0][column], -sign * (float)pose[1][column], sign * (float)pose[2][column]);
    }

    Color32[] Colours(float[] values, float low, float high)
    {
        var result = new Color32[values.Length];
        for (int i = 0; i < values.Length; i++)
            result[i] = float.IsNaN(values[i]) ? new Color32(128, 128, 128, 255)
                : colours[(int)(Mathf.Clamp01((values[i] - low) / (high - low)) * (colours.Length - 1))];
        return result;
    }
}
